"""False alarms of monitors on pushes that go as they should, and how soon a blocked object is noticed.

Usage: python benchmarks/push_monitor.py [--pushes 200] [--out FILE.json]
"""

import argparse
from pathlib import Path

import numpy as np

from foretrace.experiments.push_executions import push_executions
from foretrace.files import write_json

FALSE_ALARMS, SEED = 0.05, 11


def main() -> None:
    """Print the rates, and write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pushes", type=int, default=200)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    false, delays = [], []
    for number in range(options.pushes):
        free, held = push_executions(SEED, number)
        false.append(np.isfinite(free.alarm(FALSE_ALARMS)))
        delays.append(held.alarm(FALSE_ALARMS) - held.times[len(held.times) // 2])
    noticed = np.array(delays) > 0  # what alarms before is noticed by chance
    summary = {
        "pushes": len(false),
        "promised": FALSE_ALARMS,
        "false_alarms": float(np.mean(false)),
        "seed": SEED,
        "blocked_noticed": float(np.mean(noticed)),
        "delay_s": np.percentile(np.array(delays)[noticed], [50, 95]).round(3).tolist(),
    }
    print(summary)
    if options.out:
        write_json(options.out, summary)


if __name__ == "__main__":
    main()
