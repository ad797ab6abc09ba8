"""The real daemon, its search in a process of its own, and an autopilot over UDP that believes to be elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapters.fake_autopilot import UdpWire, dialect
from adapters.hovering import TRUE_NED, TRUTH, HoveringAutopilot, config, running, wait_for
from replay import rendered

from ortholoc_edge.daemon import Daemon
from ortholoc_edge.pipeline.finder import Finder, SearchOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome

# Beyond what the tracker looks for around the autopilot's own position (25 m, 1-sigma).
ASTRAY_M = 120.0


class LostAutopilot(HoveringAutopilot):
    """Without GNSS, and believes to be somewhere else; its barometer is right."""

    def _stream(self, message_id: int, now_ns: int) -> Any:
        if message_id == dialect.MAVLINK_MSG_ID_GPS_RAW_INT:
            return dialect.MAVLink_gps_raw_int_message(0, 1, 0, 0, 0, 9999, 9999, 0, 0, 0)
        if message_id == dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            north, east, down = map(float, TRUE_NED)
            ms = (now_ns - self.boot_ns) // 1_000_000
            return dialect.MAVLink_local_position_ned_message(ms, north - ASTRAY_M, east, down, 0.0, 0.0, 0.0)
        return super()._stream(message_id, now_ns)


def photos(folder: Path) -> Path:
    photo = rendered.write_picture(folder / "photos" / "photo_000.jpg", rendered.picture(TRUTH))
    for number in range(1, 600):
        photo.with_name(f"photo_{number:03d}.jpg").hardlink_to(photo)
    return photo.parent


def test_lost_without_gnss_it_is_found_in_the_whole_map(tmp_path: Path) -> None:
    autopilot = LostAutopilot(UdpWire())
    outcomes: list[Outcome] = []
    daemon = Daemon(
        config(
            f"folder:{photos(tmp_path)}", f"udpout:127.0.0.1:{autopilot.wire.port}",
            search=SearchOptions(lost_after_s=0.5),
        ),
        on_outcome=lambda _, outcome: outcomes.append(outcome),
    )  # fmt: skip
    try:
        with running(daemon):
            wait_for(lambda: sum(isinstance(o, Fix) for o in outcomes) >= 3, "three fixes", seconds=55.0)
            statistics = daemon.statistics()
            told = wait_for(lambda: autopilot.messages("ODOMETRY")[2:], "estimates")
            texts = [str(message.text) for message in autopilot.messages("STATUSTEXT")]
    finally:
        autopilot.close()
    first = next(k for k, outcome in enumerate(outcomes) if isinstance(outcome, Fix))
    assert first > 0, "it was lost"
    for outcome in outcomes:
        if isinstance(outcome, Fix):
            assert np.linalg.norm(outcome.map_from_camera.translation - TRUTH.translation) < 1.0
    assert statistics["found_again"] == 1
    assert statistics["searches_found"] >= 2
    # One clean reset: all that the autopilot was told is of the same one.
    assert len({message.reset_counter for message in told}) == 1
    assert "OrthoLoC: no fix, searching the map" in texts
    assert any(text.startswith("OrthoLoC: found") for text in texts)


def test_a_defect_of_the_search_does_not_end_the_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("a defect")

    monkeypatch.setattr(Finder, "step", fails)
    autopilot = HoveringAutopilot(UdpWire())
    outcomes: list[Outcome] = []
    daemon = Daemon(
        config(
            f"folder:{photos(tmp_path)}", f"udpout:127.0.0.1:{autopilot.wire.port}", search=SearchOptions()
        ),
        on_outcome=lambda _, outcome: outcomes.append(outcome),
    )
    try:
        with running(daemon):
            wait_for(lambda: sum(isinstance(o, Fix) for o in outcomes) >= 8, "eight fixes")
            wait_for(lambda: daemon.statistics().get("search_errors", 0) >= 8, "eight errors")
    finally:
        autopilot.close()
