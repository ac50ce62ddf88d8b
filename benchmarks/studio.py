"""How soon the studio and the service answer.

`drag`: from the moment a visitor's pointer moves the contact until the last message of the new picture arrives, over
viser's websocket without a browser, one drag after the other; `work` is the page's own share of it. `predict`:
requests to the service over HTTP at a given rate, each from the moment when it should have been sent.
"""

import argparse
import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
CORNERS = [[0.09, 0.0], [0.02, 0.08], [-0.07, 0.05], [-0.08, -0.04], [0.03, -0.08]]


def summary(seconds: list[float]) -> dict[str, float]:
    median, p95, p99 = np.percentile(1000 * np.array(seconds), [50, 95, 99])
    return {"n": len(seconds), "median_ms": median, "p95_ms": p95, "p99_ms": p99}


def drags(count: int) -> dict[str, dict[str, float]]:
    from foretrace.studio.server import StudioServer
    from studio_visitor import Visitor

    server, taken = StudioServer(port=0), []
    with Visitor(server.address) as visitor:
        visitor.look(lambda: "/rim" in visitor.nodes, 60)
        visitor.set("play", False)
        visitor.look(seconds=1.0)
        page = next(iter(server.pages.values()))
        for k in range(count):
            angle = 0.1 + 2.399963 * k  # never twice at the same place
            before = visitor.drawn
            started = time.perf_counter()
            visitor.move(0.2 * np.cos(angle), 0.2 * np.sin(angle))
            visitor.look(lambda before=before: visitor.drawn != before, 10)
            taken.append(time.perf_counter() - started)
        work = page.latencies[-count:]
    server.stop()
    return {"drag": summary(taken), "work": summary(work)}


def requests(count: int, rate: float) -> dict[str, float]:
    program = [sys.executable, "-m", "foretrace", "serve", "--port", "0"]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        host = process.stdout.readline().strip().removeprefix("http://")
        rng = np.random.default_rng(0)
        bodies = []
        for angle in rng.uniform(0, 2 * np.pi, count):
            contact = (0.075 * np.array([np.cos(angle), np.sin(angle)])).tolist()
            known = {"object": {"kind": "prism", "corners": CORNERS}, "action": {"contact": contact}}
            bodies.append(json.dumps(known))
        begin = time.perf_counter() + 1.0

        def ask(k: int) -> float:
            due = begin + k / rate
            time.sleep(max(0.0, due - time.perf_counter()))
            connection = HTTPConnection(host)
            connection.request("POST", "/predict", bodies[k], {"Content-Type": "application/json"})
            answer = connection.getresponse()
            answer.read()
            assert answer.status == 200, answer.status
            connection.close()
            return time.perf_counter() - due

        with ThreadPoolExecutor(8) as threads:
            taken = list(threads.map(ask, range(count)))
        process.terminate()
    return summary(taken[count // 10 :])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drags", type=int, default=300)
    parser.add_argument("--requests", type=int, default=500)
    parser.add_argument("--rate", type=float, default=50.0, help="requests per second")
    options = parser.parse_args()
    found = drags(options.drags) | {"predict": requests(options.requests, options.rate)}
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
