"""The measurement of a start: that it is one of the real daemon, and that what fails is told."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from ortholoc_sim import demo_pack_path

from ortholoc_edge.bench.start import find_place, time_start, view_from
from ortholoc_edge.cli import main
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

CAMERA = Camera.from_focal(320, 240, 270.0)
DOWN = np.diag([1.0, -1.0, -1.0])


def test_a_daemon_is_ready_and_then_the_autopilot_has_a_fix(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench-start", "--runs", "1", "--json"]) == 0
    record = msgspec.json.decode(capsys.readouterr().out)
    (start,) = record["starts"]
    assert 0 < start["ready_s"] < start["first_s"]
    assert 0 < start["ready_cpu_s"] <= start["first_cpu_s"]


def test_a_daemon_that_ends_is_told_with_its_last_words(tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    config.write_text("[camera]\n", encoding="utf-8")
    with pytest.raises(OrtholocError, match=r"ended with 78 before ready; it said: .*config\.toml: .*source"):
        time_start(config, lambda: None)


def test_a_view_is_of_the_map_and_of_nothing_else() -> None:
    with MapStore(Pack.open(demo_pack_path())) as store:
        place = find_place(store, CAMERA, 80.0)
        view = view_from(store, CAMERA, Rigid3(DOWN, place))
        assert view is not None and view.shape == (240, 320) and view.std() > 10.0
        west, south, *_ = store.bounds
        assert view_from(store, CAMERA, Rigid3(DOWN, np.array([west, south, place[2]]))) is None
        assert view_from(store, CAMERA, Rigid3(DOWN, place - [5000.0, 0.0, 0.0])) is None
        with pytest.raises(OrtholocError, match="no view of 5000 m"):
            find_place(store, CAMERA, 5000.0)
