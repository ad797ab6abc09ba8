"""One small world, made once: the tests of this folder share it."""

from __future__ import annotations

import pytest
from ortholoc_sim.epoch import FLIGHT, SURVEY
from ortholoc_sim.make_demo_pack import DEMO_CRS, DEMO_SOUTH_M, DEMO_UNDULATION_M, DEMO_WEST_M
from ortholoc_sim.site import Site
from ortholoc_sim.world import Scene, World, WorldSpec, build_scene, generate

from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.vertical import derive_offsets

# A quarter of a metre: a tenth of the demo's work, the same code.
SMALL = WorldSpec(seed=5, width_m=320.0, height_m=280.0, gsd_m=0.25)


@pytest.fixture(scope="session")
def world() -> World:
    return generate(SMALL)


@pytest.fixture(scope="session")
def survey(world: World) -> Scene:
    return build_scene(world, SURVEY)


@pytest.fixture(scope="session")
def flight(world: World) -> Scene:
    return build_scene(world, FLIGHT)


@pytest.fixture(scope="session")
def site() -> Site:
    anchor = (DEMO_WEST_M + 300.0, DEMO_SOUTH_M + 250.0)
    vertical = derive_offsets("ellipsoid", None, DEMO_UNDULATION_M, None)[0]
    return Site(Georeference(DEMO_CRS, vertical, anchor), [*anchor, 430.0])
