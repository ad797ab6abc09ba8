"""Fixtures of the peers' tests."""

from pathlib import Path

import pytest

from .peer_process import find_python


@pytest.fixture(scope="session")
def peers_python() -> Path:
    """Python with the peers; without it the test is skipped and says how to get it."""
    return find_python()
