"""Options of the test suite."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

import type_checks

if TYPE_CHECKING:
    from foretrace.simulation.recording import RecordingTruth

# Neither a deadline nor a check of how long examples take to draw: that says more about the machine than about the
# code. Continuous integration tries the same examples every time; elsewhere new ones are searched for.
settings.register_profile(
    "foretrace",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=bool(os.environ.get("CI")),
)
settings.load_profile("foretrace")

type_checks.install()


@pytest.fixture(autouse=True, scope="session")
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Nothing is kept in the user's cache, and nothing found there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def registered():
    """Whatever a test registers is gone after it."""
    from foretrace.features import FEATURES
    from foretrace.predictor import PREDICTORS

    for registry in (FEATURES, PREDICTORS):
        list(registry.values())  # those that are declared register themselves once
    before = [(registry, dict(registry._entries)) for registry in (FEATURES, PREDICTORS)]
    yield
    for registry, entries in before:
        registry._entries = entries


@pytest.fixture
def untyped():
    """Arguments reach the code whatever their type, as they do for users; elsewhere the suite checks types."""
    import jaxtyping

    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="write the golden files anew, then look at the diff"
    )


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> "tuple[Path, RecordingTruth]":
    """Folder and truth of the recorded lever-up of `recorded_scene`; not to be written to."""
    import recorded_scene
    from foretrace.errors import SimulationError

    folder = tmp_path_factory.mktemp("recorded") / "recording"
    try:
        return folder, recorded_scene.record(folder)
    except SimulationError as error:
        pytest.skip(str(error))
