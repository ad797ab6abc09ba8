"""A configuration changed in flight: what may change does, the rest is named, and what is broken changes nothing."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
from adapters.fake_autopilot import UdpWire
from adapters.hovering import TRUTH, HoveringAutopilot, config, wait_for
from replay import rendered
from test_daemon import toml

from ortholoc_edge.adapters.computer import ComputerReader
from ortholoc_edge.config import Config, read_config
from ortholoc_edge.daemon import Daemon
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.reload import RELOADABLE, plan_reload

BASE = config("folder:/photos", "udpout:127.0.0.1:9")


def changed(**tables: dict[str, object]) -> Config:
    new = {name: msgspec.structs.replace(getattr(BASE, name), **keys) for name, keys in tables.items()}
    return msgspec.structs.replace(BASE, **new)


def test_what_may_change_does_and_the_rest_stays() -> None:
    new = changed(
        tracker={"lost_sigma_m": 90.0}, timing={"budget_ms": 80.0, "max_age_ms": 50.0}, map={"cache_mb": 4},
        bus={"commands": True, "vehicle": "owl"}, localizer={"search_sigmas": 3.0},
    )  # fmt: skip
    plan = plan_reload(BASE, new)
    assert plan.changed == {
        "tracker.lost_sigma_m": (150.0, 90.0), "timing.budget_ms": (200.0, 80.0), "bus.commands": (False, True),
    }  # fmt: skip
    assert set(plan.refused) == {"timing.max_age_ms", "map.cache_mb", "bus.vehicle", "localizer.search_sigmas"}
    assert plan.config.tracker.lost_sigma_m == 90.0 and plan.config.bus.commands
    assert plan.config.timing.max_age_ms == BASE.timing.max_age_ms
    assert plan.config.map == BASE.map and plan.config.bus.vehicle == BASE.bus.vehicle
    # Named again the next time, for it still needs a restart.
    again = plan_reload(plan.config, new)
    assert (again.changed, again.refused) == ({}, plan.refused)
    assert plan_reload(BASE, BASE).changed == {}


def test_tables_that_change_as_a_whole() -> None:
    gate = msgspec.structs.replace(BASE.localizer.gate, min_contrast=12.0)
    plan = plan_reload(BASE, changed(localizer={"gate": gate}, attitude={"sigma_deg": (2.0, 2.0, 5.0)}))
    assert set(plan.changed) == {"localizer.gate.min_contrast", "attitude.sigma_deg"}
    assert plan.config.localizer.gate == gate
    assert plan.config.attitude.sigma_deg == (2.0, 2.0, 5.0)


@pytest.mark.parametrize("key", RELOADABLE)
def test_every_key_that_may_change_exists(key: str) -> None:
    table = msgspec.to_builtins(BASE)
    for part in key.split("."):
        table = table[part]


class _NoFrames:
    def read(self, timeout_s: float) -> None:
        return None

    def close(self) -> None:
        pass


def test_the_page_measures_by_the_budget_in_force() -> None:
    daemon = Daemon(BASE, frames=_NoFrames())
    try:
        computer = ComputerReader().read()
        assert daemon._reporter._page_health(0, computer).budget_ms == 200.0
        daemon._take_over(plan_reload(BASE, changed(timing={"budget_ms": 80.0}, ladder={"rates_hz": ()})))
        health = daemon._reporter._page_health(0, computer)
        assert (health.budget_ms, health.rungs) == (80.0, 3)
    finally:
        daemon.close()


# -- as a process --------------------------------------------------------------


class Running:
    """The daemon in a process, with what it tells systemd."""

    def __init__(
        self, folder: Path, endpoint: str, program: tuple[str, ...] = ("-m", "ortholoc_edge"), more: str = ""
    ) -> None:
        self.path = folder / "config.toml"
        self.text = toml(folder / "photos", endpoint).replace("rate_hz = 2.0", "rate_hz = 8.0") + more
        self.path.write_text(self.text, encoding="utf-8")
        self.told: list[str] = []
        self._log = (folder / "stderr").open("w+", encoding="utf-8")
        self._supervisor = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._supervisor.bind(str(folder / "notify"))
        self._supervisor.settimeout(20.0)
        self.process = subprocess.Popen(
            [sys.executable, *program, "run", "--config", str(self.path)],
            env={**os.environ, "NOTIFY_SOCKET": str(folder / "notify")}, stderr=self._log,
        )  # fmt: skip

    def log(self) -> str:
        return Path(self._log.name).read_text(encoding="utf-8")

    def logged(self, words: str) -> None:
        """Wait for it: a thread of its own writes the log."""
        wait_for(lambda: words in self.log(), words)

    def told_until(self, wanted: Callable[[str], bool]) -> list[str]:
        """What systemd is told from now on, up to what is wanted."""
        found: list[str] = []
        while not found or not wanted(found[-1]):
            found.append(self._supervisor.recv(4096).decode())
        return found

    def reload(self, text: str) -> list[str]:
        self.path.write_text(text, encoding="utf-8")
        self.process.send_signal(signal.SIGHUP)
        self.told_until(lambda line: line.startswith("RELOADING=1\nMONOTONIC_USEC="))
        return self.told_until(lambda line: line == "READY=1")

    def close(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(10.0)
        finally:
            self.process.kill()
            self.process.wait()
            self._supervisor.close()
            self._log.close()


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[tuple[Running, HoveringAutopilot]]:
    photo = rendered.write_picture(tmp_path / "photos" / "photo_000.jpg", rendered.picture(TRUTH))
    for number in range(1, 400):
        photo.with_name(f"photo_{number:03d}.jpg").hardlink_to(photo)
    autopilot = HoveringAutopilot(UdpWire())
    running = Running(tmp_path, f"udpout:127.0.0.1:{autopilot.wire.port}")
    yield running, autopilot
    running.close()
    autopilot.close()


def test_sighup_changes_what_may_change_in_flight(daemon: tuple[Running, HoveringAutopilot]) -> None:
    running, autopilot = daemon
    running.told_until(lambda line: line == "READY=1")

    def sent() -> int:
        return len(autopilot.messages("ODOMETRY"))

    wait_for(sent, "an estimate")
    # A gate that nothing passes, and keys that can't change.
    strict = running.text.replace("rate_hz = 8.0", "rate_hz = 4.0") + (
        '[localizer.gate]\nmin_contrast = 1e6\nmin_sure_contrast = 1e6\n[log]\nlevel = "warning"\n'
    )
    running.reload(strict)
    running.logged("reload: localizer.gate.min_contrast is now 1000000.0 (was 10.5)")
    running.logged("reload: camera.rate_hz can't change in flight; restart needed")
    status = running.told_until(lambda line: line.startswith("STATUS=") and "restart needed" in line)[-1]
    assert "restart needed for camera.rate_hz" in status
    running.told_until(lambda line: line.startswith("STATUS=coast"))
    # A typo changes nothing, and says where it is.
    running.reload(running.text + "[localizer.gate]\nmin_kontrast = 3\n")
    running.logged("reload: the old configuration stays in force")
    running.logged("min_kontrast")
    count = sent()
    running.told_until(lambda line: line.startswith("STATUS="))
    running.told_until(lambda line: line.startswith("STATUS="))
    assert sent() == count, "the strict gate is still in force"
    # Gone, as while an editor replaces it.
    running.path.unlink()
    running.process.send_signal(signal.SIGHUP)
    running.told_until(lambda line: line == "READY=1")
    running.logged("can't be read")
    running.reload(running.text)
    wait_for(lambda: sent() > count, "estimates with the old gate")
    assert running.process.poll() is None
    running.logged("reload: log.level is now info (was warning)")
    running.process.send_signal(signal.SIGTERM)
    assert running.process.wait(10.0) == 0
    assert "Traceback" not in running.log()


def test_a_file_whose_parts_contradict_each_other_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "config.toml"
    path.write_text(toml(tmp_path, "udpout:127.0.0.1:9") + "[witness]\nsuspect_score = 200\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"suspect_score 200.*\$\.witness"):
        read_config(path)
