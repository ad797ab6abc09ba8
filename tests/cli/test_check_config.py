"""``check-config``, the examples in config/, and the page that explains every key."""

from __future__ import annotations

import json
import re
from pathlib import Path

import msgspec
import pytest

from ortholoc_edge.cli import EXIT_CONFIG, main
from ortholoc_edge.cli.check_config import read_example
from ortholoc_edge.config import config_text, read_config

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "config").glob("*.toml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_can_be_flown_with(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-config", str(path)]) == 0
    said = capsys.readouterr().out
    assert "can be flown with" in said and "has no use for" not in said
    assert path.name in (ROOT / "config" / "README.md").read_text(encoding="utf-8")
    assert main(["check-config", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(config_text(read_config(path)))


def test_there_is_an_example_for_each_kind_of_vehicle() -> None:
    assert {"ardupilot-serial", "px4-udp", "pi5", "jetson", "simulation"} <= {path.stem for path in EXAMPLES}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[bus]\nencodings = 1\n", r"`encodings`.*did you mean `encoding`\? \[bus\] has: enabled, vehicle"),
        ("[localizer.gate]\nmin_kontrast = 3\n", r"did you mean `min_contrast`\? \[localizer.gate\] has: min_inliers"),
        ("[looger]\n", r"`looger`.*the file has: camera, intrinsics"),
        ("[bus]\nxyz = 1\n", r"`xyz` - at `\$\.bus`; \[bus\] has: "),
    ],
)
def test_a_wrong_key_is_named_with_the_valid_ones(
    text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "config.toml"
    base = (ROOT / "config" / "simulation.toml").read_text(encoding="utf-8").replace("[bus]", "[bus.tls]\n[bus]", 1)
    base = re.sub(r"\[bus\.tls\]\n\[bus\]\n(?:\w.*\n)+", "", base)
    path.write_text(base + text, encoding="utf-8")
    assert main(["check-config", str(path)]) == EXIT_CONFIG
    assert re.search(words, capsys.readouterr().err)


@pytest.mark.parametrize(
    ("source", "idle"),
    [
        ("device:/dev/video0", ""),
        ("picamera2:0", "format"),
        ("gstreamer:v4l2src ! appsink", "gain, format, width_px, fps"),
        ("rtsp://10.0.0.2/live", "stamp_of, gain, format, width_px, fps"),
        ("folder:pictures", "latency_ms, stamp_of, exposure_ms, gain, format, width_px, fps"),
    ],
)
def test_keys_that_a_source_has_no_use_for_are_named(
    source: str, idle: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "config.toml"
    text = (ROOT / "config" / "pi5.toml").read_text(encoding="utf-8")
    given = f'source = "{source}"\ngain = 2.0\nstamp_of = "frame_end"\n'
    path.write_text(re.sub(r"(?m)^(height_px = .*\n)(?=fps)|^source = .*\n", "", text).replace(
        "[camera]\n", f"[camera]\n{given}", 1
    ), encoding="utf-8")  # fmt: skip
    assert main(["check-config", str(path)]) == 0
    said = capsys.readouterr().out
    assert (f"[camera] {idle}: " in said) if idle else ("has no use" not in said)


def test_the_page_about_every_key_is_the_codes(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check-config", "--reference"]) == 0
    printed = capsys.readouterr().out
    page = (ROOT / "docs" / "configuration.md").read_text(encoding="utf-8")
    assert page == printed, "ortholoc-edge check-config --reference > docs/configuration.md"
    rows = re.findall(r"^\| `(\w+)`( ↻)? \| (.*) \| (.*) \| (.*) \|$", page, re.MULTILINE)
    leaves = json.loads(config_text(read_config(ROOT / "config" / "example.toml")))
    assert len(rows) == sum(1 for _ in _leaves(leaves))
    for key, _, kind, default, words in rows:
        assert kind and default and words, f"{key} is not explained; write it into config/example.toml"
    assert ("min_contrast", " ↻") in {row[:2] for row in rows}
    assert ("source", "") in {row[:2] for row in rows}


def _leaves(table: dict[str, object]) -> list[object]:
    found: list[object] = []
    for value in table.values():
        found += _leaves(value) if isinstance(value, dict) else [value]
    return found


def test_comments_belong_to_what_they_stand_behind() -> None:
    told = read_example('[a]   # of a\nx = "p # q"   # one\n          # and two\n# of all\n# y = 3 # three\n[b.c]\n')
    assert told.tables == {"a": "of a of all", "b.c": ""}
    assert told.keys["a.y"] == "three"
    assert msgspec.json.encode(told.keys["a.x"]).endswith(b'one and two"')


def test_usage(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in ([], ["x.toml", "--reference"]):
        with pytest.raises(SystemExit):
            main(["check-config", *arguments])
        assert "FILE, or --reference" in capsys.readouterr().err
