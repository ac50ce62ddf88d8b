"""Requests that schemathesis makes up from the service's own description: how many, and what they were answered.

Half of them are made up throughout; in the others, some entries of a sensible request are replaced by made-up ones.

Needs `pip install schemathesis`. The exit status is 1 if an answer is not as described, or an error of the server.
"""

import argparse
import json
from collections import Counter

import hypothesis
import schemathesis
from hypothesis import strategies
from schemathesis.specs.openapi.checks import positive_data_acceptance

from foretrace.studio.service import make_service

CORNERS = [[0.09, 0.0], [0.02, 0.08], [-0.07, 0.05], [-0.08, -0.04], [0.03, -0.08]]
KNOWN = {
    "object": {"kind": "prism", "corners": CORNERS},
    "action": {"contact": [0.0, 0.08]},
    "context": {"friction": 0.7},
}
SENSIBLE = {
    "/predict": KNOWN,
    "/plan": {"object": KNOWN["object"], "context": KNOWN["context"], "goal": {"name": "lift"}},
    "/monitors": KNOWN,
}
"""Requests that can be answered, by their paths."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--examples", type=int, default=200, help="requests for each operation")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    app, answers, faults = make_service(), Counter(), []
    schema = schemathesis.openapi.from_asgi("/openapi.json", app)
    settings = hypothesis.settings(
        max_examples=options.examples,
        deadline=None,
        database=None,
        suppress_health_check=list(hypothesis.HealthCheck),
    )

    def ask(case: schemathesis.Case, kept: set[str]) -> None:
        if isinstance(case.body, dict) and case.path in SENSIBLE and kept:
            sensible = SENSIBLE[case.path]
            case.body |= {name: value for name, value in sensible.items() if name in kept}
        response = case.call()
        answers[f"{case.method} {case.path} {response.status_code}"] += 1
        # The description knows the shape of bodies, not the geometry of objects: a refusal with 422 is as described.
        case.validate_response(response, excluded_checks=[positive_data_acceptance])

    for operation in schema.get_all_operations():
        kept = strategies.sets(strategies.sampled_from(["object", "action", "context", "goal", "samples"]))
        given = hypothesis.given(operation.ok().as_strategy(), kept)(lambda case, kept: ask(case, kept))
        try:
            hypothesis.seed(options.seed)(settings(given))()
        except (Exception, BaseExceptionGroup) as error:  # whatever a check raises
            faults.append(f"{operation.ok().path}: {str(error)[:2000]}")
    print(json.dumps({"answers": dict(sorted(answers.items())), "faults": faults}, indent=2))
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
