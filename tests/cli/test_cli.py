"""The commands as a shell runs them: what they print, where, and with which exit code."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from affine import Affine
from replay import rendered

from ortholoc_edge.bench import draw
from ortholoc_edge.bench.replay import PriorKind
from ortholoc_edge.cli import EXIT_CONFIG, EXIT_FAILED, main
from ortholoc_edge.config import read_intrinsics
from ortholoc_edge.errors import CameraError
from ortholoc_edge.geometry.rigid import Rigid3

ROOT = Path(__file__).resolve().parents[2]
PACK = rendered.store().pack.path
TRUTH = rendered.pose()
FLIGHT = [
    rendered.pose(),
    rendered.pose(318.0, 262.0, yaw_deg=34.0, roll_deg=4.0),
    rendered.pose(340.0, 270.0, yaw_deg=41.0, pitch_deg=-6.0),
]
SIFT = ("--matcher", "sift")


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rendered.write_flight(tmp_path_factory.mktemp("flight") / "demo", FLIGHT)


@pytest.fixture(scope="module")
def photo(flight: Path) -> Path:
    return flight / "photos" / "frame_00.jpg"


@pytest.fixture(scope="module")
def intrinsics(tmp_path_factory: pytest.TempPathFactory) -> Path:
    camera = rendered.CAMERA
    path = tmp_path_factory.mktemp("camera") / "K.json"
    keys = {"width_px": camera.width, "height_px": camera.height, "fx": camera.fx, "fy": camera.fy}
    path.write_text(json.dumps({**keys, "cx": camera.cx, "cy": camera.cy}), encoding="utf-8")
    return path


def position(truth: Rigid3 = TRUTH, off_m: tuple[float, float, float] = (3.0, -2.0, 2.0)) -> str:
    return ",".join(f"{v:.2f}" for v in truth.translation + off_m)


# -- help and errors ---------------------------------------------------------

HELP = [
    ["sim"], ["run"], ["doctor"], ["replay"], ["localize"], ["locate"], ["bench"], ["bench-replay"],
    ["models", "build"], ["models", "list"], ["tiles", "build"], ["tiles", "info"], ["tiles", "verify"],
    ["samples", "make"], ["samples", "simulate"], ["samples", "draw"], ["profile"],
]  # fmt: skip
# Their only arguments are required, or there are none.
WITHOUT_DEFAULTS = ("run", "tiles verify", "samples draw")


@pytest.mark.parametrize("command", HELP, ids=" ".join)
def test_help(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*command, "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith("usage: ortholoc-edge")
    assert "default" in text or " ".join(command) in WITHOUT_DEFAULTS
    assert "%(" not in text


def test_every_command_is_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert all(re.search(rf"^    {command[0]}\b", text, re.MULTILINE) for command in HELP)


def test_usage_errors_are_code_two(capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in ([], ["fly"], ["localize"], ["replay", "x", "--position-sigma", "5km"]):
        with pytest.raises(SystemExit) as stop:
            main(wrong)
        assert stop.value.code == 2
    assert "5km" in capsys.readouterr().err


def test_no_delay_is_one_too(capsys: pytest.CaptureFixture[str]) -> None:
    """The one that fast-forward asks for; the flight is refused for its duration alone."""
    assert main(["sim", "--viso-delay-ms", "0", "--duration", "1"]) == EXIT_CONFIG
    assert "less than 30 s" in capsys.readouterr().err


NUMBERS = [
    ("sim --viso-delay-ms=-1", "below zero"),
    ("replay x --seed=-1", "seed"),
    ("replay x --seed 1.5", "seed"),
    ("replay x --attitude-sigma-deg=-1,1,3", "from 0 to 180"),
    ("replay x --attitude-sigma-deg=1,nan,3", "finite"),
    ("replay x --attitude-sigma-deg 1,3", "three numbers"),
    ("replay x --odometer-drift nan", "finite"),
    ("replay x --odometer-drift=-inf", "finite"),
    ("replay x --odometer-error -5", "below zero"),
    ("replay x --odometer-error much", "not a number"),
    ("replay x --position-sigma nan", "no length"),
    ("replay x --threads 0", "threads"),
    ("replay x --working-px -32", "working-px"),
    ("replay x --max-keypoints 0", "max-keypoints"),
    ("sim --seed=-1", "seed"),
    ("sim --duration nan", "finite"),
    ("sim --duration inf", "finite"),
    ("sim --duration 0", "above zero"),
    ("bench-replay x --seeds 0", "seeds"),
    ("bench-replay x --seeds=-3", "seeds"),
    ("bench x --working-px 0", "working-px"),
    ("localize x --pack y --position nan,2,3", "finite"),
    ("localize x --pack y --position 1,2", "three numbers"),
    ("localize x --pack y --geodetic 999,0,2", "latitude"),
    ("localize x --pack y --geodetic 0,181,2", "longitude"),
    ("localize x --pack y --geodetic 0,0,inf", "finite"),
    ("localize x --pack y --attitude a,b,c", "three numbers"),
    ("localize x --pack y --attitude-sigma-deg nan,1,1", "finite"),
    ("localize x --pack y --attitude-sigma-deg 1,-1,1", "from 0 to 180"),
    ("localize x --pack y --attitude-sigma-deg 1,1e300,1", "from 0 to 180"),
    ("localize x --pack y --position 1e300,0,0", "not on the Earth"),
    (f"localize x --pack y --height-sigma {'9' * 400}", "farther than"),
]


@pytest.mark.parametrize(("line", "named"), NUMBERS, ids=[line[:60] for line, _ in NUMBERS])
def test_impossible_numbers_are_usage_errors(line: str, named: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(line.split())
    assert stop.value.code == 2
    told = capsys.readouterr().err.splitlines()[-1]
    assert "error: argument --" in told
    assert named in told


@pytest.mark.parametrize("command", ["replay x --pack y --matcher xfeat", "sim --matcher xfeat", "bench ."])
def test_working_size_for_xfeat_is_named(
    command: str, tmp_path: Path, flight: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x").symlink_to(flight)
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "a.npz").touch()
    assert run(*command.split(), "--working-px", "650") == EXIT_CONFIG
    assert "multiple of 32" in capsys.readouterr().err


def test_results_that_could_not_be_written_are_told_before_the_work(
    tmp_path: Path, photo: Path, intrinsics: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "file"
    taken.touch()
    for option, arguments in (
        ("--out", ["sim", "--out", taken / "out"]),
        ("--out", ["replay", flight, "--pack", PACK, "--out", taken]),
        ("--overlay", ["localize", photo, "--pack", PACK, "--intrinsics", intrinsics, "--overlay", taken / "a.png"]),
        ("--overlay", ["localize", photo, "--pack", PACK, "--intrinsics", intrinsics, "--overlay", tmp_path]),
    ):
        assert run(*arguments, *SIFT) == EXIT_FAILED
        told = capsys.readouterr()
        assert told.out == ""
        assert str(tmp_path) in told.err
        assert f"choose another {option}" in told.err


def test_entry_as_a_process() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "ortholoc_edge", "tiles", "info", "/nowhere/pack"],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == EXIT_FAILED
    assert done.stdout == ""
    assert "/nowhere/pack" in done.stderr
    assert "Traceback" not in done.stderr


CONFIG = (ROOT / "config" / "example.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("min_inliers = 30", "min_inlier = 30", r"min_inlier.*\$\.localizer\.gate"),
        ("working_px = 640", "working_px = 12", r"\$\.matcher\.working_px"),
        ("[tracker]", "[traker]", "traker"),
        ("fx = 910.0", 'fx = "long"', r"\$\.intrinsics\.fx"),
        ('vehicle = "vehicle"', 'vehicle = "a/*"', r"\$\.bus\.vehicle"),
        ("[camera]", "[camera", "not TOML"),
    ],
)
def test_wrong_configuration(
    old: str, new: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert CONFIG.count(old) == 1
    path = tmp_path / "wrong.toml"
    path.write_text(CONFIG.replace(old, new), encoding="utf-8")
    assert run("run", "--config", path) == EXIT_CONFIG
    told = capsys.readouterr()
    assert told.out == ""
    assert str(path) in told.err
    assert re.search(named, told.err)


@pytest.mark.parametrize("command", ["run", "doctor"])
def test_libraries_are_told_before_anything_has_threads(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV takes some settings from the environment alone, and there a change races with whoever reads."""
    path = tmp_path / "stream.toml"
    path.write_text(CONFIG.replace('"device:/dev/video0"', '"rtsp://10.0.0.2/live"'), encoding="utf-8")
    # Put back after the test.
    monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", "")
    monkeypatch.delenv("OPENCV_FFMPEG_CAPTURE_OPTIONS")
    told = []

    def begin(*_: object) -> list[object]:
        told.append(os.environ.get("OPENCV_FFMPEG_CAPTURE_OPTIONS"))
        raise CameraError("that is enough")

    monkeypatch.setattr("ortholoc_edge.cli.run.Daemon", begin)
    monkeypatch.setattr("ortholoc_edge.preflight.check_computer", begin)
    assert run(command, "--config", path, *(["--computer"] if command == "doctor" else [])) == EXIT_FAILED
    assert told and told[0] is not None and "nobuffer" in told[0]


def test_missing_files_are_named(
    tmp_path: Path, photo: Path, intrinsics: Path, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gone = tmp_path / "gone"
    cases = [
        (EXIT_CONFIG, ["run", "--config", gone]),
        (EXIT_FAILED, ["localize", gone, "--pack", PACK, "--intrinsics", intrinsics, *SIFT]),
        (EXIT_FAILED, ["localize", photo, "--pack", gone, "--intrinsics", intrinsics, *SIFT]),
        (EXIT_CONFIG, ["localize", photo, "--pack", PACK, "--intrinsics", gone, *SIFT]),
        (
            EXIT_FAILED,
            ["localize", photo, "--pack", PACK, "--intrinsics", intrinsics, "--matcher", "xfeat", "--model", gone],
        ),
        (EXIT_FAILED, ["replay", gone, "--pack", PACK, *SIFT]),
        (EXIT_FAILED, ["replay", flight, "--pack", gone, *SIFT]),
        (EXIT_FAILED, ["replay", tmp_path, "--pack", PACK, *SIFT]),
        (EXIT_FAILED, ["tiles", "info", gone]),
        (EXIT_FAILED, ["tiles", "verify", gone]),
        (EXIT_FAILED, ["tiles", "build", "--dop", gone, "--dsm", gone, "--out", tmp_path / "out"]),
        (EXIT_FAILED, ["bench", gone]),
        (EXIT_FAILED, ["bench-replay", gone]),
    ]
    for code, arguments in cases:
        assert run(*arguments) == code, arguments
        told = capsys.readouterr()
        assert str(gone if gone in arguments else tmp_path) in told.err + told.out, arguments
        assert "Traceback" not in told.err


def test_contradictions(photo: Path, intrinsics: Path, flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["localize", photo, "--pack", PACK]
    cases = [
        (["--position", "1,2,3", "--geodetic", "1,2,3", "--intrinsics", intrinsics], "--geodetic"),
        (["--attitude", "0,0,0", "--intrinsics", intrinsics], "--position"),
        ([], "--intrinsics"),
    ]
    for more, named in cases:
        assert run(*given, *more, *SIFT) == EXIT_CONFIG
        assert named in capsys.readouterr().err
    assert run("replay", flight, *SIFT) == EXIT_CONFIG
    assert "--pack" in capsys.readouterr().err


# -- tiles -------------------------------------------------------------------


def test_tiles(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(1)
    for name, bands, gsd in (
        ("dop", rng.integers(0, 256, (3, 200, 300), dtype=np.uint8), 0.5),
        ("dsm", rng.normal(400.0, 2.0, (1, 100, 150)).astype(np.float32), 1.0),
    ):
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", width=bands.shape[2], height=bands.shape[1],
            count=len(bands), dtype=bands.dtype.name, crs="EPSG:32632",
            transform=Affine(gsd, 0, 500_000.0, 0, -gsd, 5_400_000.0),
        ) as target:  # fmt: skip
            target.write(bands)
    out = tmp_path / "pack"
    build = ["tiles", "build", "--dop", tmp_path / "dop.tif", "--dsm", tmp_path / "dsm.tif", "--out", out]
    assert run(*build, "--vertical", "ellipsoid", "--geoid-undulation-m", "47") == 0
    assert "EPSG:32632" in capsys.readouterr().out
    assert run("tiles", "info", out, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["dop"]["gsd_m"], facts["dop"]["area_km2"]) == (0.5, pytest.approx(0.015))
    assert facts["vertical"]["amsl_minus_map_m"] == -47.0
    assert run("tiles", "verify", out) == 0
    assert "sound" in capsys.readouterr().out
    assert run(*build) == EXIT_FAILED
    assert "--force" in capsys.readouterr().err


# -- localize ----------------------------------------------------------------


def test_localize_json_and_overlay(
    photo: Path, intrinsics: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "overlay.png"
    code = run(
        "localize", photo, "--pack", PACK, "--intrinsics", intrinsics, "--position", position(),
        "--attitude", "1,-1,32", "--json", "--overlay", picture, *SIFT,
    )  # fmt: skip
    assert code == 0
    record = json.loads(capsys.readouterr().out)
    assert record["fix"] is True
    assert np.linalg.norm(record["position_map_m"] - TRUTH.translation) < 2.0
    assert record["attitude_rpy_true_north_deg"] == pytest.approx([0.0, 0.0, 30.0], abs=1.5)
    place = rendered.georeference().geodetic_from_map(TRUTH.translation)
    assert record["latitude_deg"] == pytest.approx(place.lat_deg, abs=2e-5)
    assert record["longitude_deg"] == pytest.approx(place.lon_deg, abs=3e-5)
    assert record["height_amsl_m"] == pytest.approx(place.height_amsl_m, abs=2.0)
    drawn = cv2.imread(str(picture))[..., ::-1]
    assert drawn.shape[1] == rendered.CAMERA.width
    assert drawn.shape[0] > rendered.CAMERA.height
    # No truth is known here: estimates only.
    assert coloured(drawn, draw.ESTIMATE) > 100
    assert coloured(drawn, draw.TRUTH) == 0


def coloured(image: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((image == colour).all(axis=-1).sum())


def test_localize_for_people(photo: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = rendered.georeference().geodetic_from_map(TRUTH.translation)
    where = f"{place.lat_deg},{place.lon_deg},{place.height_amsl_m}"
    given = ["localize", photo, "--pack", PACK, "--intrinsics", intrinsics, "--geodetic", where]
    assert run(*given, "--attitude", "0,0,30", "--position-sigma", "4%", *SIFT) == 0
    text = capsys.readouterr().out
    east, north = (float(v) for v in re.search(r"fix: E ([\d.]+) N ([\d.]+)", text).groups())
    assert np.hypot(*(TRUTH.translation[:2] - (east, north))) < 2.0
    assert "above sea level" in text
    # Half a turn off: no fix, and why.
    assert run(*given, "--attitude", "0,0,210", *SIFT) == EXIT_FAILED
    assert capsys.readouterr().out.startswith("no fix: ")


def test_localize_with_an_attitude_that_is_not_a_number(
    photo: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["localize", photo, "--pack", PACK, "--intrinsics", intrinsics, "--position", position()]
    assert run(*given, "--attitude", "nan,0,0", "--json", *SIFT) == EXIT_FAILED
    record = json.loads(capsys.readouterr().out)
    assert (record["fix"], record["reason"]) == (False, "bad_attitude")


def test_localize_with_sigmas_of_zero(photo: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Truth told as certain: a fix or a reason, never a traceback."""
    sure = ["--position-sigma", "0", "--height-sigma", "0", "--attitude-sigma-deg", "0,0,0", "--attitude", "0,0,30"]
    given = ["localize", photo, "--pack", PACK, "--intrinsics", intrinsics, "--position", position(off_m=(0, 0, 0))]
    assert run(*given, *sure, "--json", *SIFT) in (0, EXIT_FAILED)
    assert "fix" in json.loads(capsys.readouterr().out)


def test_localize_without_a_prior(photo: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The whole pack as the region: an answer of whichever kind, and never a wrong one."""
    code = run("localize", photo, "--pack", PACK, "--intrinsics", intrinsics, "--json", *SIFT)
    record = json.loads(capsys.readouterr().out)
    assert record["fix"] is (code == 0)
    if code == 0:
        assert np.linalg.norm(record["position_map_m"] - TRUTH.translation) < 10.0


# -- replay ------------------------------------------------------------------

KEYS = {
    "frames", "fixes", "rejected", "te_m", "re_deg", "recall", "false_fixes", "nees", "latency_ms", "rss_mb",
    "matcher", "model_sha256", "pack",
}  # fmt: skip


def test_replay_json_and_files(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "results"
    assert run("replay", flight, "--pack", PACK, "--json", "--out", out, *SIFT) == 0
    told = capsys.readouterr()
    (line,) = told.out.splitlines()
    summary = json.loads(line)
    assert summary.keys() >= KEYS
    assert (summary["frames"], summary["fixes"], summary["rejected"]) == (3, 3, {})
    for key in ("te_m", "re_deg"):
        assert set(summary[key]) == {"median", "p90", "p99", "max"}
    assert summary["te_m"]["max"] < 2.0
    assert set(summary["recall"]) == {"1m_1deg", "3m_3deg", "5m_5deg"}
    assert summary["recall"]["3m_3deg"] == 1.0
    assert summary["false_fixes"] == 0
    assert {"mean", "p95"} <= set(summary["nees"])
    assert {"total", "query_features", "match", "pose"} <= set(summary["latency_ms"])
    assert all(set(spent) == {"median", "p95", "p99"} for spent in summary["latency_ms"].values())
    assert summary["rss_mb"] > 10
    assert (summary["matcher"], summary["model_sha256"]) == ("sift", None)
    assert summary["pack"] == str(PACK)
    assert json.loads((out / "summary.json").read_text("utf-8")) == summary

    records = [json.loads(one) for one in (out / "frames.jsonl").read_text("utf-8").splitlines()]
    assert [record["name"] for record in records] == ["frame_00", "frame_01", "frame_02"]
    for record, truth in zip(records, FLIGHT, strict=True):
        assert record["te_m"] == pytest.approx(np.linalg.norm(record["position_map_m"] - truth.translation), abs=1e-6)
        overlay = cv2.imread(str(out / "overlays" / f"{record['name']}.png"))[..., ::-1]
        assert coloured(overlay, draw.ESTIMATE) > 50
        # Where both fall on one pixel, the estimate's is seen.
        assert coloured(overlay, draw.TRUTH) > 20
    track = cv2.imread(str(out / "track.png"))[..., ::-1]
    assert coloured(track, draw.TRUTH) > 20
    assert coloured(track, draw.ESTIMATE) > 20

    page = (out / "report.html").read_text("utf-8")
    shown = json.loads(page.split('<script type="application/json" id="data">')[1].split("</script>")[0])
    assert [frame["name"] for frame in shown["frames"]] == ["frame_00", "frame_01", "frame_02"]
    west, south, east, north = shown["map"]["bounds"]
    for frame, record in zip(shown["frames"], records, strict=True):
        assert frame["error"] == [record["te_m"], record["re_deg"]]
        assert math.dist(frame["truth"], frame["mark"]["fix"]["at"][:2]) <= record["te_m"] + 0.02
        assert west < frame["truth"][0] < east and south < frame["truth"][1] < north
        assert len(frame["picture"]["inliers"]) > 20
    assert "position error" in page and "http:" not in page and "https:" not in page


@pytest.mark.parametrize("kind", list(PriorKind))
def test_replay_with_each_prior(kind: PriorKind, flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["--prior", kind, "--position-sigma", "3%", "--height-sigma", "2m", "--seed", "4", "--no-adhop"]
    assert run("replay", flight, "--pack", PACK, "--json", *given, *SIFT) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["prior"], summary["seed"], summary["adhop"]) == (str(kind), 4, False)
    assert summary["fixes"] == 3
    assert summary["te_m"]["max"] < 5.0


def test_replay_table(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("replay", flight, "--pack", PACK, "--no-adhop", *SIFT) == 0
    text = capsys.readouterr().out
    for word in ("recall", "1m-1deg", "position error", "false fixes", "latency total", "peak memory"):
        assert word in text


@pytest.mark.parametrize("kind", ["number", "pair"])
def test_replay_of_an_ortholoc_sample(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In a frame of its own, as OrthoLoC's are: the corner of the window is zero."""
    east, north, _ = TRUTH.translation
    window = rendered.store().read_colour((east - 60, north - 60, east + 60, north + 60), 0.25)
    assert window is not None
    grid = window.grid
    u, v = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
    xy = grid.map_from_px(np.stack([u, v], axis=-1))
    heights = rendered.store().heights(xy.reshape(-1, 2)).reshape(u.shape)
    origin = np.array([grid.west, grid.top, 0.0])
    truth = Rigid3(TRUTH.rotation, TRUTH.translation - origin)
    inverse = truth.inverse()
    np.savez(
        tmp_path / "sample.npz",
        image_query=rendered.picture(TRUTH),
        image_dop=window.rgb,
        dsm=(np.dstack([xy, heights]) - origin).astype(np.float32),
        scale=np.array(grid.dx) if kind == "number" else np.array([grid.dx, grid.dy]),
        extrinsics=np.column_stack([inverse.rotation, inverse.translation]),
        intrinsics=rendered.CAMERA.matrix,
    )
    given = ["replay", tmp_path / "sample.npz", "--json", "--no-adhop", *SIFT]
    for asked in ("odometer", "gps"):
        assert run(*given, "--prior", asked) == 0
        assert json.loads(capsys.readouterr().out)["prior"] == "truth-noise"
    assert run("replay", tmp_path / "sample.npz", "--json", "--prior", "none", *SIFT) == 0
    summary = json.loads(capsys.readouterr().out)
    assert (summary["prior"], summary["frames"], summary["fixes"]) == ("none", 1, 1)
    assert (summary["seed"], summary["seeds"]) == (0, 1)
    assert summary["te_m"]["max"] < 3.0
    assert summary["re_deg"]["max"] < 2.0


# -- bench -------------------------------------------------------------------


@pytest.fixture(scope="module")
def sets(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight with rasters, a broken sample beside it, and a set that can't be read."""
    data = tmp_path_factory.mktemp("data")
    for name in ("good", "also"):
        shutil.copytree(flight, data / name)
        rendered.write_map(
            rendered.map_window(160.0, 0.25), data / name / f"{name}_dop.tif", data / name / f"{name}_dsm.tif"
        )
    next((data / "also").glob("*_flight.csv")).write_text("nothing\n1\n", encoding="utf-8")
    (data / "good" / "samples").mkdir()
    (data / "good" / "samples" / "a.npz").write_bytes(b"no archive")
    return data


def test_bench_replay_goes_on_after_a_set_that_fails(sets: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["bench-replay", sets, "--matchers", "sift", "--priors", "odometer", "--adhop", "off", "--seeds", "2"]
    assert run(*given, "--json") == EXIT_FAILED
    told = capsys.readouterr()
    (line,) = told.out.splitlines()
    summary = json.loads(line)
    assert (summary["sequence"], summary["pack"]) == ("good", "built from the set")
    assert (summary["frames"], summary["seed"], summary["seeds"]) == (2 * len(FLIGHT), 0, 2)
    assert re.search(r"ortholoc-edge: also: .*flight\.csv", told.err)
    assert re.search(r"ortholoc-edge: good samples: .*a\.npz", told.err)
    assert "2 of 3 sets failed: also, good samples" in told.err


def test_bench_replay_of_one_set_finds_its_samples_once(sets: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["--matchers", "sift", "--priors", "odometer", "--adhop", "off", "--seeds", "1"]
    assert run("bench-replay", sets / "good", *given) == EXIT_FAILED
    told = capsys.readouterr()
    assert [line.split(" | ")[0] for line in told.out.splitlines()[2:]] == ["| good"]
    assert "1 of 2 sets failed: good samples" in told.err


# -- calibrate-focal ---------------------------------------------------------


def test_photos_of_a_flight_tell_the_camera(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From the paper's guess, 480 px where 405 is right."""
    out = tmp_path / "K.json"
    assert run("calibrate-focal", flight, "--pack", PACK, "--each", "--json", "--out", out) == 0
    told = json.loads(capsys.readouterr().out)
    true = rendered.CAMERA
    assert told["photos_used"] == 3
    assert told["true_focal_px"] == pytest.approx(true.focal_px)
    assert told["error_percent"] == pytest.approx(100 * (told["focal_px"] / true.focal_px - 1))
    assert abs(told["focal_px"] - true.focal_px) < 3.5 * told["focal_sigma_px"]
    assert told["focal_sigma_px"] < 0.05 * true.focal_px
    assert abs(told["intrinsics"]["cx"] - true.cx) < 3.5 * told["sigmas"]["cx"]
    assert all(photo["focal_distance_correlation"] < -0.5 for photo in told["photos"])
    assert told["photos"][0]["height_above_ground_m"] == pytest.approx(rendered.HEIGHT_M, abs=8.0)
    for photo in told["photos"]:
        alone = photo["alone"]
        assert not alone["calibrated"] or abs(alone["focal_px"] - true.focal_px) < 3.5 * alone["focal_sigma_px"]
    # What it writes, the others read.
    written = read_intrinsics(out, true.width, true.height)
    assert written.fx == told["focal_px"]
    assert (written.cx, written.cy) == (told["intrinsics"]["cx"], told["intrinsics"]["cy"])


def test_plain_photos_of_elsewhere_are_named_and_leave_no_camera(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (360, 480, 3), dtype=np.uint8)
    rendered.write_picture(tmp_path / "noise.png", cv2.GaussianBlur(noise, (0, 0), 3.0))
    east, north = TRUTH.translation[:2]
    out = tmp_path / "K.json"
    around = f"{east},{north},60"
    noisy = tmp_path / "noise.png"
    assert run("calibrate-focal", noisy, "--pack", PACK, "--around", around, "--out", out) == EXIT_FAILED
    told = capsys.readouterr().out
    assert "noise.png: not used: " in told
    assert "not calibrated: " in told
    assert "what helps: " in told
    assert not out.exists()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["PHOTO"], "--pack is missing"),
        (["PHOTO", "--pack", PACK, "--height-sigma", 1], "plain photos"),
        (["PHOTO", "--pack", PACK, "--around", "1,2,-3"], "radius"),
        (["PHOTO", "SMALL", "--pack", PACK, "--around", "1,2,30"], "one camera at a time"),
        (["FLIGHT"], "no *_dop.tif"),
        (["FLIGHT", "PHOTO", "--pack", PACK], "together"),
        (["PHOTO", "--pack", PACK, "--matcher", "structural"], "name a matcher of features"),
    ],
)
def test_what_cannot_be_calibrated_is_said(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[object], complaint: str
) -> None:
    small = rendered.write_picture(tmp_path / "small.png", np.zeros((60, 80, 3), np.uint8))
    places = {"PHOTO": flight / "photos" / "frame_00.jpg", "SMALL": small, "FLIGHT": flight}
    assert run("calibrate-focal", *(places.get(str(one), one) for one in arguments)) == EXIT_CONFIG
    assert complaint in capsys.readouterr().err


# -- samples -----------------------------------------------------------------


@pytest.fixture(scope="module")
def samples(flight: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of one made sample, in the data set's layout; a second photo is off the map."""
    folder = tmp_path_factory.mktemp("samples")
    head, first, *_ = (flight / "rendered_flight.csv").read_text(encoding="utf-8").splitlines()
    cells = first.split(",")
    cells[head.split(",").index("utm_e")] = "700000"
    (folder / "short").mkdir()
    (folder / "short" / "short_flight.csv").write_text("\n".join([head, first, ",".join(cells)]), encoding="utf-8")
    (folder / "short" / "photos").symlink_to(flight / "photos")
    return folder


def test_samples_are_made_of_a_flight_then_studied_and_drawn(
    samples: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run("samples", "make", PACK, samples / "short", samples / "out", "--split", "val") == 0
    told = capsys.readouterr()
    made = samples / "out" / "val" / "short_R0000.npz"
    assert told.out.split() == [str(made)]
    assert "short_R0001: 0 % of the photo shows the map" in told.err

    truth = ["bench", samples / "out", "--matcher", "ground-truth", "--study", "confidence"]
    assert run(*truth, "--split", "val", "--json") == 0
    (piece,) = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert (piece["sample"], piece["kind"], piece["split"]) == ("val/short_R0000.npz", "R", "val")
    assert sorted(one["condition"]["min_confidence"] for one in piece["results"]) == [0.0, 0.5, 0.95, 0.99]
    for one in piece["results"]:
        if one["condition"]["min_confidence"] > 0.9:
            assert one["te_m"] < 0.005
            assert one["re_deg"] < 0.005

    report = tmp_path / "report"
    compared = ["bench", samples / "out", "--matcher", "orb", "--task", "localize,calibrate", "--study", "domain"]
    assert run(*compared, "--turns", "2", "--out", report) == 0
    told = capsys.readouterr().out
    assert "### Localize: all samples" in told
    assert "### What AdHoP changes: calibrate" in told
    for name in ("localize", "calibrate", "adhop_localize", "domain_calibrate"):
        for ending in (".md", ".csv", ".tex"):
            assert (report / "tables" / f"{name}{ending}").stat().st_size > 0
    assert (report / "tables" / "domain_localize.png").stat().st_size > 0
    page = (report / "report.html").read_text("utf-8")
    assert page.count("data:image/jpeg") >= 2
    written = (report / "results.jsonl").read_bytes()
    # All is there: nothing is measured again.
    assert run(*compared, "--turns", "2", "--out", report) == 0
    assert capsys.readouterr().out == told
    assert (report / "results.jsonl").read_bytes() == written
    assert run(*compared, "--out", report) == EXIT_CONFIG
    assert "another --out" in capsys.readouterr().err

    assert run("samples", "draw", samples / "out", tmp_path) == 0
    assert cv2.imread(str(tmp_path / "short_R0000.png")).shape[1] == 1920

    # A sample that can't be read is told, the table is of the others.
    (made.parent / "short_xDOP0000.npz").write_bytes(b"no archive")
    capsys.readouterr()
    assert run(*truth) == EXIT_FAILED
    told = capsys.readouterr()
    assert "| ground-truth | off | R | 0.95 |" in told.out
    assert "short_xDOP0000.npz: not a readable" in told.err
    assert "1 of 2 pieces of work failed" in told.err


@pytest.mark.parametrize(
    ("arguments", "words", "code"),
    [
        (["bench", "nowhere", "--study", "confidence"], "nowhere: no .npz file", EXIT_FAILED),
        (["samples", "draw", "nowhere", "out"], "nowhere: no .npz file", EXIT_FAILED),
        (["samples", "make", PACK, "nowhere", "out"], "0 files named", EXIT_FAILED),
    ],
)
def test_samples_say_what_is_wrong(
    arguments: list[str], words: str, code: int, capsys: pytest.CaptureFixture[str],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == code
    assert words in capsys.readouterr().err


def test_a_location_is_a_plain_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run("samples", "make", PACK, "flight", "out", "--location", "../L01")
    assert stop.value.code == 2
    assert "'../L01' is not a name" in capsys.readouterr().err
