import shutil

import pytest
from tile_rasters import SHARED, real_sources, write_holed_scene, write_scene, write_wide_scene

from ortholoc_edge.tiles.build import PackOptions, build_pack


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """(DOP, DSM) of a tilted plane without holes."""
    return write_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="session")
def wide_scene(tmp_path_factory):
    """(DOP, DSM) of several tiles each."""
    return write_wide_scene(tmp_path_factory.mktemp("wide"))


@pytest.fixture(scope="session")
def plane_pack(scene, tmp_path_factory):
    return build_pack(*scene, tmp_path_factory.mktemp("plane") / "pack", PackOptions(quality=95, vertical="unknown"))


@pytest.fixture(scope="session")
def holed_pack(tmp_path_factory):
    folder = tmp_path_factory.mktemp("holed")
    return build_pack(*write_holed_scene(folder), folder / "pack", PackOptions(vertical="orthometric"))


@pytest.fixture
def copied(holed_pack, tmp_path):
    """Path of a pack that a test may damage."""
    return shutil.copytree(holed_pack.path, tmp_path / "pack")


@pytest.fixture(scope="session")
def real_pack(tmp_path_factory):
    """Builder of packs from the real sets by name, each built once."""
    built = {}

    def get(name):
        sources = real_sources(name)
        if sources is None:
            pytest.skip(f"no real rasters of {name} under {SHARED}")
        if name not in built:
            built[name] = build_pack(*sources, tmp_path_factory.mktemp(name) / "pack", PackOptions(vertical="unknown"))
        return built[name], sources

    return get
