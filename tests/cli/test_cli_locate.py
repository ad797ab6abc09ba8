"""``locate`` as a shell runs it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from replay import rendered

from ortholoc_edge.cli import EXIT_CONFIG, EXIT_FAILED, main

PACK = rendered.store().pack.path
TRUTH = rendered.pose()


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered.write_flight(tmp_path_factory.mktemp("flight") / "demo", [TRUTH])


@pytest.fixture(scope="module")
def intrinsics(tmp_path_factory: pytest.TempPathFactory) -> Path:
    camera, path = rendered.CAMERA, tmp_path_factory.mktemp("camera") / "K.json"
    keys = {"width_px": camera.width, "height_px": camera.height, "fx": camera.fx, "fy": camera.fy}
    path.write_text(json.dumps({**keys, "cx": camera.cx, "cy": camera.cy}), encoding="utf-8")
    return path


def test_photos_of_a_flight(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("locate", flight, "--pack", PACK, "--json", "--overlay", tmp_path / "drawn") == 0
    told = capsys.readouterr()
    [record] = [json.loads(line) for line in told.out.splitlines()]
    assert record["image"] == "frame_00.jpg"
    assert record["fix"] is True
    assert record["error_m"] < 1.0
    assert record["candidates_away_m"][0] < 5.0
    assert record["lead"] > 1.1
    assert "m per pixel" in told.err
    assert (tmp_path / "drawn" / "frame_00.png").stat().st_size > 10_000


def test_one_photo_for_people(flight: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]) -> None:
    east, north, _ = TRUTH.translation
    code = run(
        "locate", flight / "photos" / "frame_00.jpg", "--pack", PACK, "--intrinsics", intrinsics, "--agl",
        rendered.HEIGHT_M, "--attitude", "0,0,36", "--within", f"{east + 40:.0f},{north - 30:.0f},150",
    )  # fmt: skip
    assert code == 0
    text = capsys.readouterr().out
    assert text.startswith("frame_00.jpg: fix: E ")
    found = np.array([float(text.split(" E ")[1].split()[0]), float(text.split(" N ")[1].split()[0])])
    assert np.linalg.norm(found - (east, north)) < 1.0
    assert "times as well as the next place" in text


def test_what_is_missing_is_named(
    flight: Path, intrinsics: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    photo = flight / "photos" / "frame_00.jpg"
    cases = [
        (EXIT_CONFIG, [photo, "--pack", PACK, "--agl", "80"], "--intrinsics"),
        (EXIT_CONFIG, [photo, "--pack", PACK, "--intrinsics", intrinsics], "--agl or --height"),
        (EXIT_FAILED, [photo, "--pack", tmp_path, "--intrinsics", intrinsics, "--agl", "80"], str(tmp_path)),
        (
            EXIT_FAILED,
            [photo, "--pack", PACK, "--intrinsics", intrinsics, "--agl", "80", "--within", "0,0,50"],
            "widen",
        ),
        (EXIT_FAILED, [tmp_path / "gone.jpg", "--pack", PACK, "--intrinsics", intrinsics, "--agl", "80"], "gone.jpg"),
    ]
    for code, arguments, named in cases:
        assert run("locate", *arguments) == code, arguments
        assert named in capsys.readouterr().err, arguments
    for wrong in (["--within", "1,2,0"], ["--agl", "0"], ["--heading-within", "200"], ["--agl", "80", "--height", "1"]):
        with pytest.raises(SystemExit) as stop:
            run("locate", photo, "--pack", PACK, *wrong)
        assert stop.value.code == 2
        capsys.readouterr()
