"""Options of the test suite."""

import os

import pytest
from hypothesis import settings

# Continuous integration tries the same examples every time; elsewhere new ones are searched for.
settings.register_profile("ci", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("ci")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--update-golden", action="store_true", help="write the golden files anew, then look at the diff"
    )
