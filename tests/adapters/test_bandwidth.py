"""What a serial line must carry, and what is refused."""

from __future__ import annotations

import contextlib
import logging
import math
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions
from ortholoc_edge.adapters.mavlink.bandwidth import LinePlan, frame_bytes, plan_line, total_bytes_per_s
from ortholoc_edge.adapters.mavlink.options import parse_endpoint
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.errors import ConfigError


def plan(baud: int = 57600, **options) -> LinePlan:
    endpoint = f"serial:/dev/ttyX:{baud}"
    return plan_line(LinkOptions(endpoint=endpoint, **options), parse_endpoint(endpoint))


def test_frame_sizes_are_those_of_the_wire():
    """A message without a zero at its end, packed."""
    mav = dialect.MAVLink(None, 1, 197)
    beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    sync = dialect.MAVLink_timesync_message(2**62, 2**62)
    assert frame_bytes("HEARTBEAT", is_signed=False) == len(beat.pack(mav)) == 21
    assert frame_bytes("TIMESYNC", is_signed=False) == len(sync.pack(mav)) == 28
    mav.signing.secret_key, mav.signing.sign_outgoing = b"k" * 32, True
    assert frame_bytes("TIMESYNC", is_signed=True) == len(sync.pack(mav)) == 41
    assert frame_bytes("ODOMETRY", is_signed=False) == 245


def test_shares_add_up():
    """By hand, of the contract's frame sizes: 10 Hz of ODOMETRY are 43 % of 57600 baud."""
    told = plan(autopilot="ardupilot", computer_status_rate_hz=0, quality_rate_hz=0)
    odometry = next(share for share in told.to_autopilot if share.message == "ODOMETRY")
    assert odometry.bytes_per_s / told.capacity_bytes_per_s == pytest.approx(0.425, abs=0.001)
    # Estimates, heartbeat, time asked for (1 Hz) and answered (0.1 Hz), a command per second.
    assert total_bytes_per_s(told.to_autopilot) == pytest.approx(2450 + 21 + 1.1 * 28 + 45)
    assert "ONBOARD_COMPUTER_STATUS" not in [share.message for share in told.to_autopilot]
    both = plan(computer_status_rate_hz=1.0, quality_rate_hz=1.0)
    extra = total_bytes_per_s(both.to_autopilot) - total_bytes_per_s(told.to_autopilot)
    # PX4, for which an unknown autopilot is taken, asks for the time ten times a second.
    assert extra == pytest.approx(252 + 3 * 30 + 9.9 * 28)
    endpoint = parse_endpoint("serial:/dev/ttyX:57600")
    gimbal = plan_line(LinkOptions(endpoint="serial:/dev/ttyX:57600"), endpoint, has_gimbal=True)
    more = total_bytes_per_s(gimbal.from_autopilot) - total_bytes_per_s(plan().from_autopilot)
    assert more == 20 * frame_bytes("GIMBAL_DEVICE_ATTITUDE_STATUS", is_signed=False)


@pytest.mark.parametrize(
    ("options", "way", "names"),
    [
        ({"estimate_rate_hz": 20.0}, "to the autopilot", ["ODOMETRY 20 Hz x 245 B = 4900", "lower estimate_rate_hz"]),
        (
            {"attitude_rate_hz": 100.0},
            "from the autopilot",
            ["ATTITUDE_QUATERNION 100 Hz x 60 B = 6000", "lower attitude_rate_hz", "115200 is enough"],
        ),
        ({"position_rate_hz": 40.0}, "from the autopilot", ["lower position_rate_hz"]),
    ],
)
def test_what_the_line_cannot_carry_is_refused(options, way, names):
    with pytest.raises(ConfigError) as refused:
        AutopilotLink(LinkOptions(endpoint="serial:/dev/ttyX:57600", **options), SystemClock())
    text = str(refused.value)
    assert "carries 5760 bytes/s" in text and "4608 may be planned" in text and way in text
    for name in names:
        assert name in text


def test_what_fits_is_not_refused():
    for baud in (57600, 921600):
        plan(baud).require_fit()
    # At 80 % of the line, to the byte.
    told = plan()
    load = total_bytes_per_s(told.from_autopilot)
    for baud, fits in ((math.ceil(load / 0.8) * 10, True), (math.floor(load / 0.8) * 10 - 10, False)):
        line = LinePlan("serial:x", baud, told.to_autopilot, told.from_autopilot, True)
        with contextlib.nullcontext() if fits else pytest.raises(ConfigError):
            line.require_fit()
    plan_line(
        LinkOptions(endpoint="udp:127.0.0.1:14550", estimate_rate_hz=50.0, attitude_rate_hz=400.0),
        parse_endpoint("udp:127.0.0.1:14550"),
    ).require_fit()


def test_signatures_count(tmp_path):
    """The default streams fit 57600 baud, but not with 13 bytes more on each."""
    key = tmp_path / "key"
    key.write_bytes(b"k" * 32)
    key.chmod(0o600)
    with pytest.raises(ConfigError, match="ATTITUDE_QUATERNION 50 Hz x 73 B"):
        plan(signing_key=str(key)).require_fit()


def test_timesync_warning_is_for_px4_on_slow_lines():
    assert plan().timesync_wire_ms == pytest.approx(9.72, abs=0.01)
    assert "9.7 ms" in plan().timesync_warning() and "460800" in plan().timesync_warning()
    assert plan(autopilot="px4").timesync_warning() is not None
    assert plan(autopilot="ardupilot").timesync_warning() is None
    assert plan(460800).timesync_warning() is None


def test_plan_is_said_at_the_start(caplog, tmp_path):
    caplog.set_level(logging.INFO)
    with AutopilotLink(LinkOptions(endpoint=f"serial:{tmp_path}/ttyX:57600"), SystemClock()):
        pass
    lines = [r.getMessage() for r in caplog.records]
    assert any(line.startswith("link to the autopilot: ") and "% of the line" in line for line in lines)
    assert any(line.startswith("link from the autopilot: ") and "ATTITUDE_QUATERNION 50 Hz" in line for line in lines)
    assert any(r.levelname == "WARNING" and "TIMESYNC" in r.getMessage() for r in caplog.records)


def test_documented_figures_are_those_of_the_plan():
    text = (Path(__file__).resolve().parents[2] / "docs" / "link.md").read_text(encoding="utf-8")
    for name, options in (("plain", {}), ("signed", {"signing_key": "/key"})):
        told = plan(**options)
        to, back = (f"{total_bytes_per_s(way):.0f} bytes/s" for way in (told.to_autopilot, told.from_autopilot))
        assert f"| {name} | {to} | {back} |" in text
