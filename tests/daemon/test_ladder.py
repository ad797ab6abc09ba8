"""The real daemon on a computer that gets hot and cools: what it leaves out, whom it tells, and what a replay says."""

from __future__ import annotations

import socket
import urllib.request
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import pytest
from adapters.fake_autopilot import UdpWire
from adapters.hovering import TRUTH, HoveringAutopilot, config, running, wait_for
from mcap.reader import make_reader
from replay import rendered

from ortholoc_edge.adapters.computer import ComputerReader
from ortholoc_edge.adapters.flight_log import LogOptions
from ortholoc_edge.adapters.messages import LadderMessage
from ortholoc_edge.adapters.page.options import PageOptions
from ortholoc_edge.cli import main
from ortholoc_edge.daemon import Daemon
from ortholoc_edge.pipeline import ladder
from ortholoc_edge.pipeline.ladder import LadderOptions
from ortholoc_edge.pipeline.navigator import TimingOptions


class _Bus:
    dropped = refused = 0
    accepts_commands = False

    def __init__(self) -> None:
        self.steps: list[LadderMessage] = []

    def publish(self, message: Any) -> None:
        if isinstance(message, LadderMessage):
            self.steps.append(message)

    def publish_image(self, stamp_ns: int, image: Any) -> None:
        pass


def test_a_hot_computer_computes_less_and_all_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # A minute in some seconds.
    monkeypatch.setattr("ortholoc_edge.reporting._INTERVAL_NS", 100_000_000)
    monkeypatch.setattr(ladder, "_HEAT_AGAIN_NS", 400_000_000)
    monkeypatch.setattr(ladder, "_WAIT_NS", 300_000_000)
    monkeypatch.setattr(ladder, "_FRAMES_UP", 2)
    monkeypatch.setattr(ladder, "_WITHOUT_ROOM", 0)
    photo = rendered.write_picture(tmp_path / "photos" / "photo_000.jpg", rendered.picture(TRUTH))
    for number in range(1, 400):
        photo.with_name(f"photo_{number:03d}.jpg").hardlink_to(photo)
    zone = tmp_path / "computer/sys/class/thermal/thermal_zone0"
    zone.mkdir(parents=True)
    (zone / "type").write_text("cpu-thermal\n")

    def heat(celsius: int) -> None:
        # At once, as a file of the kernel's: a reader sees no empty one.
        (zone / "next").write_text(f"{celsius}000\n")
        (zone / "next").rename(zone / "temp")

    heat(60)
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    wire = UdpWire()
    autopilot = HoveringAutopilot(wire)
    daemon = Daemon(
        config(
            f"folder:{tmp_path / 'photos'}",
            f"udpout:127.0.0.1:{wire.port}",
            timing=TimingOptions(max_age_ms=20_000.0, budget_ms=10_000.0),
            ladder=LadderOptions(rates_hz=(2.0,)),
            log=LogOptions(folder=str(tmp_path / "log"), frames="all"),
            page=PageOptions(enabled=True, listen=f"127.0.0.1:{port}"),
        ),
        computer=ComputerReader(tmp_path / "computer"),
    )
    bus = daemon._reporter._bus = _Bus()  # type: ignore[assignment]

    def fixes() -> int:
        return int(daemon.statistics().get("fixes", 0))

    def told(words: str) -> list[Any]:
        return [message for message in autopilot.messages("STATUSTEXT") if words in message.text]

    try:
        with running(daemon):
            wait_for(lambda: fixes() >= 2, "fixes")
            assert daemon.statistics()["rung"] == 0
            heat(84)
            wait_for(lambda: daemon.statistics()["rung"] == 3, "the last rung")
            skipped, before = daemon.statistics().get("frames_skipped", 0), fixes()
            wait_for(lambda: fixes() >= before + 2, "fixes there, too")
            assert daemon.statistics()["frames_skipped"] > skipped, "of eight frames a second two are localized"
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/state.json", timeout=5.0) as answer:
                health = msgspec.json.decode(answer.read())["health"]
            heat(65)
            wait_for(lambda: daemon.statistics()["rung"] == 0, "all of it again")
            wait_for(lambda: told("full detail and rate again"), "a line for the pilot")
    finally:
        autopilot.close()
    assert [(step.was, step.rung, step.cause) for step in bus.steps] == [
        (0, 1, "heat"), (1, 2, "heat"), (2, 3, "heat"), (3, 2, "room"), (2, 1, "room"), (1, 0, "room"),
    ]  # fmt: skip
    assert (bus.steps[2].rungs, bus.steps[2].details, bus.steps[2].rate_hz) == (4, 3, 2.0)
    assert bus.steps[2].why == "processor hot, 84 C"
    assert (health["rung"], health["rungs"], health["rate_hz"], health["rung_why"], health["budget_ms"]) == (
        3, 4, 2.0, "processor hot, 84 C", 10_000.0,
    )  # fmt: skip
    assert told("OrthoLoC: 2 Hz at most: processor hot, 84 C")
    assert len(told("less detail: processor hot")) == 2
    (log,) = (tmp_path / "log").glob("flight-*.mcap")
    with log.open("rb") as file:
        kinds = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
        file.seek(0)
        rungs = {
            msgspec.json.decode(message.data)["rung"]
            for _, _, message in make_reader(file).iter_messages(topics=["/ortholoc/frame"])
        }
    assert kinds["/ortholoc/ladder"] == 6
    assert {0, 2} <= rungs <= {0, 1, 2}, "each step has its rung of detail"
    assert main(["replay", str(tmp_path / "log"), "--json"]) == 0, "the same, bit for bit, on a cool computer"
    assert msgspec.json.decode(capsys.readouterr().out)
