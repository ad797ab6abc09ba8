"""``doctor`` from end to end: the command against a fake autopilot over real UDP and a pseudo-terminal."""

from __future__ import annotations

import io
import json
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from adapters.fake_autopilot import FakeAutopilot, PtyWire, UdpWire
from adapters.firmware_parameters import ARDUPILOT_READY, ARDUPILOT_STOCK, PX4_STOCK
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.mavlink import audit, parameters, protocol
from ortholoc_edge.cli import doctor, main

CONFIG = Path(__file__).resolve().parents[2] / "config" / "example.toml"


@pytest.fixture(autouse=True)
def listening_is_short_and_lenient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_LISTEN_NS", 1_000_000_000)
    # Half the patience: what is absent, read-only or silent is so after seconds, too.
    for name in ("_REQUEST_INTERVAL_NS", "_PATIENCE_NS", "_WRITE_PATIENCE_NS"):
        value = getattr(parameters, name)
        monkeypatch.setattr(parameters, name, value // 4 if isinstance(value, int) else tuple(v // 2 for v in value))
    # A busy test machine is not what is tested here: rates and round trips are judged in test_audit.
    monkeypatch.setattr(audit, "_LEAST_RATE_RATIO", 0.0)
    monkeypatch.setattr(audit, "_PX4_MOST_ROUND_TRIP_MS", 1000.0)


@contextmanager
def autopilot(parameters: dict[str, int | float], wire: UdpWire | PtyWire | None = None, **fields: Any) -> Iterator:
    """(the autopilot, its endpoint); disarmed."""
    wire = wire or UdpWire()
    made = {name: fields.pop(name) for name in ("autopilot", "version", "system_id") if name in fields}
    fake = FakeAutopilot(wire, **made)
    fake.parameters = dict(parameters)
    fake.base_mode = 0
    for name, value in fields.items():
        setattr(fake, name, value)
    endpoint = f"serial:{wire.path}:921600" if isinstance(wire, PtyWire) else f"udpout:127.0.0.1:{wire.port}"
    try:
        yield fake, endpoint
    finally:
        fake.close()


def findings(text: str) -> dict[str, dict[str, Any]]:
    return {finding["subject"]: finding for finding in json.loads(text)["findings"]}


def test_a_stock_ardupilot_is_read_and_left_alone(capsys: pytest.CaptureFixture[str]) -> None:
    with autopilot(ARDUPILOT_STOCK) as (fake, endpoint):
        assert main(["doctor", "--link", endpoint]) == 1
        assert fake.parameters == ARDUPILOT_STOCK and fake.got_counts["PARAM_SET"] == 0
    text = capsys.readouterr().out
    assert "ardupilot 4.5.7, system 7" in text and "50.7000000, 7.1000000, 60.00 m AMSL" in text
    assert "error    VISO_TYPE: 0; wanted: 1, after a reboot" in text and "param set VISO_TYPE 1" in text
    assert "param set EK3_SRC2_POSXY 6" in text
    assert "2 errors" in text


def test_a_development_build_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with autopilot(ARDUPILOT_READY, version=(4, 8, 0), version_type=0) as (_, endpoint):
        assert main(["doctor", "--link", endpoint]) == 0
    text = capsys.readouterr().out
    assert "ardupilot 4.8.0 (dev build), system 7" in text and "note     firmware: 4.8.0 (dev build)" in text


def test_a_set_up_that_works_over_a_serial_line(capsys: pytest.CaptureFixture[str]) -> None:
    with autopilot(ARDUPILOT_READY, PtyWire(), slow={"VISO_TYPE": 2, "EK3_ENABLE": 1}) as (_, endpoint):
        assert main(["doctor", "--link", endpoint, "--latency-ms", "20"]) == 0
    text = capsys.readouterr().out
    assert "nothing wrong" in text and f"{endpoint}\n" in text


def test_ardupilot_is_mended(capsys: pytest.CaptureFixture[str]) -> None:
    with autopilot(ARDUPILOT_STOCK) as (fake, endpoint):
        assert main(["doctor", "--link", endpoint, "--fix", "--yes"]) == 0
        assert fake.parameters == {**ARDUPILOT_STOCK, "VISO_TYPE": 1, "EK3_SRC2_POSXY": 6}
    text = capsys.readouterr().out
    assert "VISO_TYPE = 1, read back" in text and "restart the autopilot for VISO_TYPE\n" in text


def configured(folder: Path, **link: Any) -> str:
    """The example's configuration with strings or numbers of [link] replaced."""
    text = CONFIG.read_text(encoding="utf-8")
    for name, value in link.items():
        text, found = re.subn(rf'(?m)^{name} = (".*?"|[\d.]+)', f"{name} = {json.dumps(value)}", text)
        assert found == 1
    path = folder / "configured.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize(
    ("release", "latency_ms", "viso_delay_ms"),
    [("fast-forward", 150, 0), ("fixed-latency", 150, 250), ("raw", 150, 150), (None, 150, 0)],
)
def test_a_latency_counts_as_the_release_makes_of_it(
    release: str | None, latency_ms: int, viso_delay_ms: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with autopilot({**ARDUPILOT_READY, "VISO_DELAY_MS": 200}) as (fake, endpoint):
        command = ["doctor", "--link", endpoint, "--latency-ms", str(latency_ms), "--fix", "--yes"]
        main(command if release is None else [*command, "--config", configured(tmp_path, release=release)])
        # Half a round trip comes to it.
        assert viso_delay_ms <= fake.parameters["VISO_DELAY_MS"] <= min(viso_delay_ms + 15, 250)
    text = capsys.readouterr().out
    assert f'old on arrival, with release = "{release or "fast-forward"}"' in text
    assert ("assumed for want of --config" in text) == (release is None)


def test_px4_is_mended_in_its_own_encoding(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = configured(tmp_path, release="raw")
    with autopilot(PX4_STOCK, autopilot=dialect.MAV_AUTOPILOT_PX4, version=(1, 14, 3)) as (fake, endpoint):
        command = ["doctor", "--config", config, "--link", endpoint, "--latency-ms", "220", "--fix", "--yes", "--json"]
        assert main(command) == 0
        assert fake.parameters == {**PX4_STOCK, "EKF2_EV_CTRL": 1, "EKF2_HGT_REF": 0, "EKF2_DELAY_MAX": 270.0}
    facts = json.loads(capsys.readouterr().out)
    assert (facts["autopilot"], facts["firmware"]) == ("px4", "1.14.3")
    assert all(change["accepted"] for change in facts["changes"]) and len(facts["changes"]) == 3
    assert facts["parameters"]["EKF2_EV_CTRL"] == 1 and facts["parameters"]["SER_TEL3_BAUD"] is None


def test_each_change_is_asked_for(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))  # then the input ends, which is a no
    with autopilot(ARDUPILOT_STOCK) as (fake, endpoint):
        assert main(["doctor", "--link", endpoint, "--fix"]) == 1
        assert fake.parameters_set == [("VISO_TYPE", 1)]
    captured = capsys.readouterr()
    assert "set VISO_TYPE from 0 to 1? [y/N]" in captured.err and "set EK3_SRC2_POSXY from 0 to 6?" in captured.err


def test_a_refused_change_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with autopilot(ARDUPILOT_STOCK, read_only={"VISO_TYPE"}) as (fake, endpoint):
        assert main(["doctor", "--link", endpoint, "--fix", "--yes"]) == 1
        assert fake.parameters["VISO_TYPE"] == 0 and fake.parameters["EK3_SRC2_POSXY"] == 6
    text = capsys.readouterr().out
    assert "VISO_TYPE is not 1: it keeps 0" in text and "restart the autopilot" not in text


def test_an_armed_vehicle_is_left_alone(caplog: pytest.LogCaptureFixture) -> None:
    armed = dialect.MAV_MODE_FLAG_SAFETY_ARMED
    with autopilot(ARDUPILOT_STOCK, base_mode=armed) as (fake, endpoint):
        assert main(["doctor", "--link", endpoint, "--fix", "--yes"]) == 1
        assert fake.got_counts["PARAM_SET"] == 0
    assert "armed; nothing is changed" in caplog.text


class Answers:
    """Standard input of somebody who answers yes, and does something before the given answer."""

    def __init__(self, before: int, action: Callable[[], None]) -> None:
        self.before, self.action, self.asked = before, action, 0

    def readline(self) -> str:
        self.asked += 1
        if self.asked == self.before:
            self.action()
        return "y\n"


@pytest.mark.parametrize("before", [1, 2])
def test_a_vehicle_that_is_armed_before_the_answer_is_left_alone(
    before: int, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with autopilot(ARDUPILOT_STOCK) as (fake, endpoint):

        def arm() -> None:
            fake.base_mode = dialect.MAV_MODE_FLAG_SAFETY_ARMED
            time.sleep(0.6)  # its heartbeat comes five times a second

        answers = Answers(before, arm)
        monkeypatch.setattr("sys.stdin", answers)
        assert main(["doctor", "--link", endpoint, "--fix"]) == 1
        assert answers.asked == before and len(fake.parameters_set) == before - 1
    assert "the vehicle is armed" in caplog.text


def test_a_vehicle_that_fell_silent_is_left_alone(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with autopilot(ARDUPILOT_STOCK) as (fake, endpoint):

        def fall_silent() -> None:
            monkeypatch.setattr(protocol, "_SILENT_AFTER_NS", 1_000_000_000)
            fake.mute = True
            time.sleep(1.2)

        monkeypatch.setattr("sys.stdin", Answers(1, fall_silent))
        assert main(["doctor", "--link", endpoint, "--fix"]) == 1
        assert fake.got_counts["PARAM_SET"] == 0
    assert "not known" in caplog.text and "nothing is changed" in caplog.text


def test_firmware_without_a_parameter_says_so_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    bare = {name: value for name, value in ARDUPILOT_READY.items() if not name.startswith("VISO_")}
    with autopilot(bare, tells_errors=True) as (_, endpoint):
        assert main(["doctor", "--link", endpoint, "--json"]) == 1
    assert findings(capsys.readouterr().out)["VISO_TYPE"]["found"] == "this firmware has none"


def test_parameters_that_are_not_answered(capsys: pytest.CaptureFixture[str]) -> None:
    with autopilot({}) as (_, endpoint):
        assert main(["doctor", "--link", endpoint, "--json"]) == 1
    found = findings(capsys.readouterr().out)
    assert list(found) == ["parameters"] and found["parameters"]["level"] == "error"


def test_mavlink_1_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with autopilot({**ARDUPILOT_READY, "SERIAL2_PROTOCOL": 1}, mavlink1=True) as (_, endpoint):
        assert main(["doctor", "--link", endpoint, "--json"]) == 1
    assert findings(capsys.readouterr().out)["MAVLink version"]["remedy"] == "param set SERIAL2_PROTOCOL 2"


def test_no_origin(capsys: pytest.CaptureFixture[str]) -> None:
    with autopilot(ARDUPILOT_READY, origin=None) as (fake, endpoint):
        assert main(["doctor", "--link", endpoint, "--json"]) == 1
        assert fake.got_counts["SET_GPS_GLOBAL_ORIGIN"] == 0
    assert "origin" in findings(capsys.readouterr().out)


def test_wrong_system_id(capsys: pytest.CaptureFixture[str]) -> None:
    with autopilot(ARDUPILOT_READY) as (_, endpoint):
        assert main(["doctor", "--link", endpoint, "--system-id", "3", "--timeout", "2", "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert [f["subject"] for f in facts["findings"]] == ["system id"] and facts["autopilot"] is None
    assert facts["peers"] == [{"system_id": 7, "component_id": 1, "autopilot": "ardupilot", "role": "quadrotor"}]


def test_nobody_there(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as mute:
        mute.bind(("127.0.0.1", 0))
        endpoint = f"udpout:127.0.0.1:{mute.getsockname()[1]}"
        assert main(["doctor", "--link", endpoint, "--timeout", "1"]) == 1
    text = capsys.readouterr().out
    assert "heard  nobody" in text and "not one byte arrived" in text


def test_configuration_tells_the_lever_arm_and_the_messages(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "config.toml"
    text = CONFIG.read_text(encoding="utf-8").replace("lever_arm_m = [0.0,", "lever_arm_m = [0.3,")
    config.write_text(text, encoding="utf-8")
    with autopilot({**ARDUPILOT_READY, "VISO_POS_X": 0.3}) as (_, endpoint):
        assert main(["doctor", "--config", str(config), "--link", endpoint, "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert facts["sinks"] == ["odometry"]
    assert [f["subject"] for f in facts["findings"] if f["level"] == "error"] == ["VISO_POS_X"]


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ([], "--link"),
        (["--link", "udp:127.0.0.1:1", "--yes"], "--fix"),
        (["--link", "udp:127.0.0.1:1", "--system-id", "256"], "1 to 255"),
        (["--link", "udp:127.0.0.1:1", "--timeout", "0"], "above zero"),
    ],
)
def test_usage(arguments: list[str], problem: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["doctor", *arguments])
    assert stop.value.code == 2 and problem in capsys.readouterr().err


def test_help_names_every_exit_status_and_what_is_asked_of_the_autopilot(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["doctor", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "78 the configuration or the endpoint" in text and "SET_MESSAGE_INTERVAL" in text


def test_endpoints_that_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--link", "carrier:pigeon"]) == 78
    assert main(["doctor", "--link", f"serial:{tmp_path}/none:57600"]) == 1
    assert "check that the device" in capsys.readouterr().err
