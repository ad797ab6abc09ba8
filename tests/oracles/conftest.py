"""``pytest tests/oracles --rewrite-docs`` writes docs/autopilot-sinks.md anew; the diff is for review."""

from __future__ import annotations

import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rewrite-docs", action="store_true", help="write docs/autopilot-sinks.md anew")


@pytest.fixture(scope="session")
def rewrite_docs(request: pytest.FixtureRequest) -> bool:
    # Run from the top, this file is read after the command line was: the option is then not known.
    return bool(request.config.getoption("--rewrite-docs", default=False))
