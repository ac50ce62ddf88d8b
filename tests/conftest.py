"""Options of the test suite."""

import os

import pytest
from hypothesis import HealthCheck, settings

# Neither a deadline nor a check of how long examples take to draw: that says more about the machine than about the
# code. Continuous integration tries the same examples every time; elsewhere new ones are searched for.
settings.register_profile(
    "foretrace",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=bool(os.environ.get("CI")),
)
settings.load_profile("foretrace")


@pytest.fixture
def registered():
    """Whatever a test registers is gone after it."""
    from foretrace.features import FEATURES
    from foretrace.predictor import PREDICTORS

    before = [(registry, dict(registry._entries)) for registry in (FEATURES, PREDICTORS)]
    yield
    for registry, entries in before:
        registry._entries = entries


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="write the golden files anew, then look at the diff"
    )
