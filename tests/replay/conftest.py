"""``pytest tests/replay --rewrite-goldens`` writes what comes out as what is expected; the diff is for review."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rewrite-goldens", action="store_true", help="write tests/replay/goldens anew and skip")


@pytest.fixture(scope="session")
def rewrite_goldens(request: pytest.FixtureRequest) -> bool:
    # Run from the top, this file is read after the command line was: the option is then not known.
    return bool(request.config.getoption("--rewrite-goldens", default=False))
