"""``doctor --computer``: what is wrong with this computer, before the flight."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from adapters.fake_autopilot import PtyWire
from replay import rendered

from ortholoc_edge import preflight
from ortholoc_edge.adapters.camera import BadFrameError, EndOfFrames, open_source
from ortholoc_edge.adapters.camera.v4l2 import Settings
from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.adapters.mavlink.audit import Finding, Level
from ortholoc_edge.cli import EXIT_CONFIG, EXIT_FAILED, main
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.config import Config, read_config
from ortholoc_edge.errors import CameraError
from ortholoc_edge.matching import models
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.preflight import Look, Usage

EXAMPLE = Path(__file__).resolve().parents[2] / "config" / "example.toml"
S = 1_000_000_000
YEAR_2030_NS = 1_893_456_000 * S
WELL = ComputerStatus((10.0, 20.0), 1000, 4000, (55.0,), False, False, False)


def with_(base: Config, **tables: dict[str, Any]) -> Config:
    new = {name: msgspec.structs.replace(getattr(base, name), **keys) for name, keys in tables.items()}
    return msgspec.structs.replace(base, **new)


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Config:
    """Nothing is wrong with it: a folder of pictures and the demo pack."""
    folder = tmp_path_factory.mktemp("photos")
    for number in range(3):
        picture = np.full((rendered.CAMERA.height, rendered.CAMERA.width, 3), 100 + number, np.uint8)
        rendered.write_picture(folder / f"{number}.png", picture)
    simulation = read_config(EXAMPLE.parent / "simulation.toml")
    return with_(
        simulation,
        camera={"source": f"folder:{folder}", "rate_hz": 50.0},
        map={"pack": str(rendered.store().pack.path)},
        log={"folder": str(folder / "log")},
    )


def test_nothing_is_wrong_with_a_good_computer(good: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(preflight, "is_synchronised", lambda: True)
    monkeypatch.setattr(preflight.ComputerReader, "read", lambda _: WELL)
    assert preflight.check_computer(good, SystemClock(), {}) == []


def only(findings: list[Finding]) -> Finding:
    (finding,) = findings
    assert finding.remedy and finding.why and finding.wanted
    return finding


def test_a_clock_that_was_never_set() -> None:
    found = only(preflight.check_clock(S, None))
    assert (found.level, found.subject, found.found) == (Level.WARNING, "clock", "1970-01-01")
    assert "timedatectl" in found.remedy
    assert only(preflight.check_clock(YEAR_2030_NS, False)).level is Level.NOTE
    assert preflight.check_clock(YEAR_2030_NS, True) == preflight.check_clock(YEAR_2030_NS, None) == []
    assert preflight.is_synchronised() in (True, False, None)


def test_devices_are_there_and_may_be_opened(good: Config) -> None:
    absent = with_(good, camera={"source": "device:7000"}, link={"endpoint": "serial:/dev/no-such-tty:921600"})
    camera, link = preflight.check_devices(absent, os.access)
    assert "/dev/video7000 is not there" in camera.found and "/dev/no-such-tty is not there" in link.found
    wire = PtyWire()
    try:
        serial = with_(good, link={"endpoint": f"serial:{wire.path}:921600"})
        assert preflight.check_devices(serial, lambda *_: True) == []
        found = only(preflight.check_devices(serial, lambda *_: False))
        group = Path(wire.path).group()
        assert found.level is Level.ERROR and f"usermod -aG {group} $USER" in found.remedy
    finally:
        wire.close()
    assert preflight.check_devices(good, lambda *_: False) == [], "a folder and UDP are no devices"


def test_keys(good: Config, tmp_path: Path) -> None:
    named = with_(good, link={"signing_key": "mavlink"})
    assert only(preflight.check_keys(named, {})).level is Level.NOTE
    key = tmp_path / "mavlink"
    key.write_bytes(bytes(range(32)))
    key.chmod(0o644)
    found = only(preflight.check_keys(with_(good, link={"signing_key": str(key)}), {}))
    assert found.level is Level.ERROR and "chmod 600" in found.remedy
    key.chmod(0o600)
    assert preflight.check_keys(with_(good, link={"signing_key": str(key)}), {}) == []
    page = {"enabled": True, "listen": "0.0.0.0:8080", "token_file": str(key)}
    found = only(preflight.check_keys(with_(good, page=page), {}))
    assert found.subject == "token of the page" and "16 to 256" in found.remedy
    key.write_text("0123456789abcdef")
    assert preflight.check_keys(with_(good, page=page), {}) == []


def test_the_pack_and_the_memory_for_it(good: Config, tmp_path: Path) -> None:
    assert preflight.check_pack(good, WELL) == []
    found = only(preflight.check_pack(with_(good, map={"pack": str(tmp_path)}), WELL))
    assert (found.level, found.subject) == (Level.ERROR, "pack")
    found = only(preflight.check_pack(good, dataclasses.replace(WELL, memory_used_mib=3900)))
    assert found.subject == "memory" and found.found == "100 MiB free"
    holed = tmp_path / "pack"
    shutil.copytree(good.map.pack, holed)
    tile = next((holed / "dop").rglob("*.tif"))
    tile.unlink()
    found = only(preflight.check_pack(with_(good, map={"pack": str(holed)}), WELL))
    assert found.level is Level.WARNING and tile.name in found.found and "tiles verify" in found.remedy


def test_weights_are_there_before_the_flight(
    good: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(models.STORE_VARIABLE, str(tmp_path))
    assert preflight.check_model(good) == []
    found = only(preflight.check_model(with_(good, matcher={"name": "structural+xfeat"})))
    assert found.remedy == "ortholoc-edge models build xfeat"
    found = only(preflight.check_model(with_(good, matcher={"name": "xfeat", "model": "/no/such.onnx"})))
    assert "/no/such.onnx is no file" in found.found
    assert list(tmp_path.iterdir()) == [], "nothing is built by looking"


@pytest.mark.parametrize(
    ("status", "subjects"),
    [
        (WELL, []),
        (ComputerStatus((), 0, 0, (84.6,), False, True, False), ["heat"]),
        (ComputerStatus((), 0, 0, (), True, True, False), ["voltage", "heat"]),
    ],
)
def test_heat_and_voltage(status: ComputerStatus, subjects: list[str]) -> None:
    assert [finding.subject for finding in preflight.check_heat(status)] == subjects


def test_room_for_the_log(good: Config) -> None:
    assert preflight.check_disk(good, lambda _: Usage(1000.0, True)) == []
    found = only(preflight.check_disk(good, lambda _: Usage(10.0, True)))
    assert found.level is Level.WARNING and found.wanted == "256 MiB"
    found = only(preflight.check_disk(good, lambda _: Usage(1000.0, False)))
    assert found.level is Level.ERROR and str(good.log.folder) in found.found
    assert preflight.check_disk(with_(good, log={"folder": None}), lambda _: Usage(0.0, False)) == []


# -- the camera ----------------------------------------------------------------


class Camera:
    """Gives what it is told to."""

    def __init__(self, *frames: Frame | Exception | None) -> None:
        self._frames = list(frames)
        self.closed = False

    def read(self, timeout_s: float) -> Frame | None:
        if not self._frames:
            raise EndOfFrames
        frame = self._frames.pop(0)
        if isinstance(frame, Exception):
            raise frame
        return frame

    def close(self) -> None:
        self.closed = True


def test_a_camera_is_looked_at(good: Config) -> None:
    seen = preflight.look(lambda: open_source(good.camera, SystemClock()), SystemClock())
    assert isinstance(seen, Look)
    assert seen.sizes == ((rendered.CAMERA.width, rendered.CAMERA.height),) * 3
    assert np.allclose(seen.brightness, (100, 101, 102))
    assert (seen.alike, seen.bad) == (0, 0)
    assert seen.rate_hz == pytest.approx(50.0, rel=0.5)


def test_what_comes_of_looking() -> None:
    image = np.full((4, 6), 7, np.uint8)
    camera = Camera(
        Frame(0, image, "0"), BadFrameError("cut", 1, "1"), None, Frame(S, image, "2"), Frame(2 * S, image, "3")
    )
    seen = preflight.look(lambda: camera, SystemClock())
    assert isinstance(seen, Look) and seen.age_ms is not None
    assert dataclasses.replace(seen, age_ms=None) == Look(((6, 4),) * 3, (7.0,) * 3, 2, 1, 1.0)
    assert camera.closed
    broken = preflight.look(lambda: Camera(CameraError("gone; plug it in")), SystemClock())
    assert isinstance(broken, Finding) and broken.remedy == "plug it in"


def test_a_camera_that_gives_nothing_dark_frozen_slow_or_other_frames(good: Config) -> None:
    size = good.intrinsics.width_px, good.intrinsics.height_px
    device = with_(good, camera={"source": "device:/dev/video0", "fps": 30.0})

    def subjects(seen: Look, config: Config = device) -> list[str]:
        return [finding.found for finding in preflight.check_look(config, seen)]

    assert subjects(Look((size,) * 3, (90.0,) * 3, 0, 0, 29.0)) == []
    assert subjects(Look((), (), 0, 2, None)) == ["no frame in 5 s"]
    assert subjects(Look((size,) * 3, (90.0,) * 3, 0, 0, 8.0)) == ["8.0 frames per second"]
    assert subjects(Look((size,) * 3, (3.0,) * 3, 2, 0, 29.0)) == ["brightness 3 of 255"], "under its lens cap"
    light = with_(device, picture={"min_brightness": 30.0})
    assert subjects(Look((size,) * 3, (25.0,) * 3, 0, 0, 29.0), light) == ["brightness 25 of 255"]
    assert subjects(Look((size,) * 3, (25.0,) * 3, 0, 0, 29.0)) == []
    assert subjects(Look((size,) * 3, (90.0,) * 3, 2, 0, 29.0)) == ["the same picture again and again"]
    assert subjects(Look((size,) * 3, (90.0,) * 3, 2, 0, 29.0), good) == [], "a folder may have one picture twice"
    stream = with_(good, camera={"source": "rtsp://10.0.0.2/live", "latency_ms": 90.0, "fps": 30.0})
    frozen_and_slow = Look((size,) * 3, (90.0,) * 3, 2, 0, 8.0)
    assert subjects(frozen_and_slow, stream) == ["the same picture again and again"], "nobody asked it for a rate"
    csi = with_(good, camera={"source": "picamera2:0", "fps": 30.0})
    assert subjects(frozen_and_slow, csi) == ["8.0 frames per second", "the same picture again and again"]
    assert subjects(Look(((6, 4),), (90.0,), 0, 0, None)) == ["frames of 6 x 4 px"]
    assert subjects(Look((size,), (90.0,), 0, 3, None)) == ["3 of 4 frames can't be read"]


def test_a_camera_that_is_late_or_does_not_do_as_it_was_told(good: Config) -> None:
    size = good.intrinsics.width_px, good.intrinsics.height_px
    well = Look((size,) * 3, (90.0,) * 3, 0, 0, 30.0, 40.0)

    def found(seen: Look, **camera: Any) -> list[str]:
        findings = preflight.check_look(with_(good, camera={"fps": 30.0, **camera}), seen)
        assert all(finding.remedy and finding.why and finding.wanted for finding in findings)
        return [f"{finding.level} {finding.found}" for finding in findings]

    assert found(well, source="device:0") == []
    late = dataclasses.replace(well, age_ms=180.0)
    assert found(late, source="device:0") == ["warning frames are 180 ms old when they come"]
    assert found(late, source="folder:x") == []
    assert found(well, source="rtsp://10.0.0.2/live") == ["warning latency_ms = 0 of a stream"]
    assert found(well, source="rtsp://10.0.0.2/live", latency_ms=120.0) == []
    settings = Settings("x", ("YUYV",), "YUYV", *size, 30.0, 33.0, (0.1, 33.0), False, 3, (0, 9))
    set_so = dataclasses.replace(well, settings=settings)
    assert found(set_so, source="device:0", format="MJPG", exposure_ms=4.0) == [
        "warning format YUYV", "warning exposure 33 ms"
    ]  # fmt: skip
    by_itself = dataclasses.replace(
        well, settings=dataclasses.replace(settings, automatic=True, exposure_ms=None)
    )
    assert found(by_itself, source="device:0") == ["note exposure is automatic"]
    assert found(by_itself, source="device:0", exposure_ms="auto") == []


# -- the command ---------------------------------------------------------------


def test_the_command(good: Config, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """With the example: on this machine there is neither its camera nor its pack."""
    assert main(["doctor", "--config", str(EXAMPLE), "--computer", "--json"]) == EXIT_FAILED
    found = {finding["subject"]: finding for finding in json.loads(capsys.readouterr().out)["findings"]}
    assert found["pack"]["level"] == "error" and found["pack"]["remedy"]
    assert main(["doctor", "--config", str(EXAMPLE), "--computer"]) == EXIT_FAILED
    assert "error    pack: " in capsys.readouterr().out
    assert main(["doctor", "--config", str(tmp_path / "none.toml"), "--computer"]) == EXIT_CONFIG
    for more in ([], ["--config", str(EXAMPLE), "--fix"], ["--link", "udp:127.0.0.1:1", "--config", str(EXAMPLE)]):
        with pytest.raises(SystemExit):
            main(["doctor", "--computer", *more])
        assert "--computer goes with" in capsys.readouterr().err or not more
