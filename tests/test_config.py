"""What the configuration refuses: by file and key, before anything is opened."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ortholoc_edge.adapters.bus import Bus, BusOptions
from ortholoc_edge.adapters.messages import rejection_message
from ortholoc_edge.config import read_config, read_intrinsics
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.matching.registry import make_method
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline.outcome import Reason, Rejected

EXAMPLE = (Path(__file__).resolve().parents[1] / "config" / "example.toml").read_text(encoding="utf-8")


def write(folder: Path, *changes: tuple[str, str]) -> Path:
    text = EXAMPLE
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "drone.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        (
            'enabled = false             # true: serve it\nlisten = "127.0.0.1:8080"',
            'enabled = true\nlisten = "0.0.0.0:8080"',
            r"\$\.page\.listen`: 0\.0\.0\.0:8080 can be reached from other computers",
        ),
        # Not finite.
        ("latency_ms = 45.0", "latency_ms = nan", r"camera\.latency_ms"),
        ("\nrate_hz = 10.0 ", "\nrate_hz = nan ", r"camera\.rate_hz"),
        ("fx = 910.0", "fx = nan", r"intrinsics\.fx"),
        ("cy = 359.5", "cy = inf", r"intrinsics\.cy"),
        ("[0.0, 0.0, 0.0, 0.0, 0.0]", "[0.0, 0.0, nan, 0.0, 0.0]", r"intrinsics\.distortion\[2\]"),
        ("roll_deg = 0.0", "roll_deg = nan", r"mount\.roll_deg"),
        ("\nlever_arm_m = [0.0, 0.0, 0.0]", "\nlever_arm_m = [0.0, 0.0, -inf]", r"mount\.lever_arm_m\[2\]"),
        ("search_sigmas = 2.5", "search_sigmas = nan", r"localizer\.search_sigmas"),
        ("homography_threshold_px = 5.0", "homography_threshold_px = inf", r"localizer\.homography_threshold_px"),
        ("min_spread = 0.12", "min_spread = nan", r"localizer\.gate\.min_spread"),
        ("max_innovation_sigmas = 5.0", "max_innovation_sigmas = inf", r"localizer\.gate\.max_innovation_sigmas"),
        ("odometry_drift_m_per_s = 0.2", "odometry_drift_m_per_s = inf", r"tracker\.odometry_drift_m_per_s"),
        ("lost_sigma_m = 150.0", "lost_sigma_m = nan", r"tracker\.lost_sigma_m"),
        ("sigma_deg = [1.0, 1.0, 3.0]", "sigma_deg = [1.0, nan, 3.0]", r"attitude\.sigma_deg\[1\]"),
        ("attitude_rate_hz = 50.0", "attitude_rate_hz = nan", r"link\.attitude_rate_hz"),
        pytest.param("fx = 910.0", "fx = 1" + 400 * "0", r"intrinsics", id="too large for a float"),
        # Out of range or of the wrong kind.
        ("fy = 910.0", "fy = -910.0", r"\$\.intrinsics\.fy"),
        ("width_px = 1280       # of", "width_px = 0       # of", r"\$\.intrinsics\.width_px"),
        ('"nadir-nose-up" ', '"sideways" ', r"'sideways' is no mount.*nadir-nose-up, nadir.*, forward.*\$\.mount"),
        ('gimbal = "none"', 'gimbal = "some"', r"\$\.mount\.gimbal"),
        ('gimbal = "none"', 'gimbal = "auto"', r"'nadir-nose-up' with a gimbal.*forward.*\$\.mount"),
        ("# gimbal_device = 154", "gimbal_device = 154", r"gimbal_device = 154.*\$\.mount"),
        ("gimbal_arm_m = [0.0, 0", "gimbal_arm_m = [0.1, 0", r"without a gimbal.*lever_arm_m.*\$\.mount"),
        ("gimbal_delay_ms = 0.0", "gimbal_delay_ms = nan", r"mount\.gimbal_delay_ms"),
        ('send = ["auto"]  ', "send = []  ", r"link\.send"),
        ('send = ["auto"]  ', 'send = ["auto", "odometry"]  ', r"mixes auto.*\$\.link"),
        ('send = ["auto"]  ', 'send = ["gps_input", "gps_input"]  ', r"twice.*\$\.link"),
        ("sensor_id = 1", "sensor_id = 0", r"link\.sensor_id"),
        ('folder = "/var/log/ortholoc-edge"', 'folder = ""', r"\$\.log\.folder"),
        # One table against another.
        ("# width_px = 1280", "width_px = 640", r"camera\.width_px.* 640.*intrinsics\.width_px.* 1280"),
        ("# height_px = 720", "height_px = 1080", r"camera\.height_px.* 1080.*intrinsics\.height_px.* 720"),
    ],
)
def test_refused_with_file_and_key(old: str, new: str, named: str, tmp_path: Path) -> None:
    path = write(tmp_path, (old, new))
    with pytest.raises(ConfigError, match=named) as raised:
        read_config(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    "changes",
    [
        [],
        [("# width_px = 1280", "width_px = 1280"), ("# height_px = 720", "height_px = 720")],
        [('name = "structural"', 'name = "sift"'), ("working_px = 640", "working_px = 650")],
        [("working_px = 640", "working_px = 650")],
        [('name = "structural"', 'name = "structural+sift"'), ("working_px = 640", "working_px = 650")],
        [('name = "structural"', 'name = "structural+xfeat"')],
        [('folder = "/var/log/ortholoc-edge"', "")],
        [('preset = "nadir-nose-up"', 'preset = "forward"'), ("pitch_deg = 0.0", "pitch_deg = -60")],
        [('preset = "nadir-nose-up"', 'preset = "nadir-tail-up"')],
        [('preset = "nadir-nose-up"', 'preset = "forward"'), ('gimbal = "none"', 'gimbal = "auto"')],
        [
            ('preset = "nadir-nose-up"', 'preset = "forward"'),
            ('gimbal = "none"', 'gimbal = "device"'),
            ("# gimbal_device = 154", "gimbal_device = 154"),
        ],
    ],
)
def test_accepted(changes: list[tuple[str, str]], tmp_path: Path) -> None:
    config = read_config(write(tmp_path, *changes))
    assert config.intrinsics.camera().width == 1280
    assert config.mount.body_from_camera().translation.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("name", ["xfeat", "xfeat-star", "xfeat-lighterglue", "structural+xfeat"])
def test_numbers_of_the_matcher_of_features_are_checked(name: str, tmp_path: Path) -> None:
    path = write(tmp_path, ('name = "structural"', f'name = "{name}"'), ("working_px = 640", "working_px = 650"))
    with pytest.raises(ConfigError, match=r"no multiple of 32.*640 or 672.*\$\.matcher"):
        read_config(path)


def test_without_a_matcher_it_is_structural(tmp_path: Path) -> None:
    """Which needs no model, so that a drone without network flies."""
    before, rest = EXAMPLE.split("[matcher]\n")
    path = tmp_path / "drone.toml"
    path.write_text(before + rest[rest.index("[localizer]") :], encoding="utf-8")
    options = read_config(path).matcher
    assert options.name == "structural"
    made = make_method(
        options.name, working_px=options.working_px, max_keypoints=options.max_keypoints, threads=options.threads
    )
    assert isinstance(made, Structural)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[camera", b""])
def test_no_configuration_at_all(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "drone.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"drone\.toml"):
        read_config(path)
    with pytest.raises(ConfigError, match="nowhere"):
        read_config(tmp_path / "nowhere.toml")


@pytest.mark.parametrize(
    "raw",
    [
        {"width_px": 640, "height_px": 480, "fx": float("nan"), "fy": 500, "cx": 319.5, "cy": 239.5},
        {"width_px": 640, "height_px": 480, "fx": 500, "fy": 500, "cx": 319.5, "cy": float("inf")},
        {"width_px": 640, "height_px": 480, "fx": 500},
        {"intrinsics": [[500, 0, float("nan")], [0, 500, 200], [0, 0, 1]]},
        {"intrinsics": [[500, 0], [0, 500]]},
        {"intrinsics": [[-1, 0, 300], [0, 500, 200], [0, 0, 1]]},
        [1, 2, 3],
    ],
)
def test_wrong_intrinsics_name_the_file(raw: object, tmp_path: Path) -> None:
    path = tmp_path / "K.json"
    path.write_text(json.dumps(raw), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"K\.json"):
        read_intrinsics(path, 640, 480)


# -- the bus: what a restart may mend, and what it can't -----------------------


@pytest.mark.parametrize(
    "endpoint",
    ["", "nonsense", "tcp/", "tcp/127.0.0.1", "tcp/127.0.0.1:99999", "tcp/127.0.0.1:abc", "foo/h:7", "udp/:7"],
)
def test_a_malformed_endpoint_is(endpoint: str) -> None:
    with pytest.raises(ConfigError, match=r"endpoint.*\[bus\]"):
        Bus(BusOptions(enabled=True, listen=(endpoint,)))


def test_outcomes_that_were_not_published_are_counted() -> None:
    bus = Bus(BusOptions(enabled=True, listen=("tcp/127.0.0.1:0",)))
    bus.publish(rejection_message(Rejected(1, Reason.LATE), 1))
    assert bus.dropped == 0
    bus.close()
    bus.publish(rejection_message(Rejected(2, Reason.LATE), 2))
    assert bus.dropped == 1
