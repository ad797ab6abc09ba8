"""Profiles: what is measured, how it is summed up, what is recommended; and the command on a rendered flight."""

from __future__ import annotations

import json
import re
import tomllib
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import pytest
from msgspec.structs import replace
from replay import rendered

from ortholoc_edge.bench import profile
from ortholoc_edge.bench.metrics import Latency, Spread
from ortholoc_edge.bench.profile_plot import profile_svg
from ortholoc_edge.bench.profile_process import Flown, ProfileProcess, Setting, Source, Started
from ortholoc_edge.cli import EXIT_CONFIG, EXIT_FAILED, main
from ortholoc_edge.config import MatcherOptions
from ortholoc_edge.errors import ConfigError, OrtholocError

FULL = Setting("structural", 1.0, 1, "cpu", 0, None, 4096)
HALF = Setting("structural", 0.5, 1, "cpu", 2, None, 4096)
BEGUN = Started(frames=4, truth=True, load_ms=5.0, warm_up_ms=6.0, peak_mb=90.0)


def asked(
    matchers: list[str], scales: list[float], threads: tuple[int, ...] = (1,), provider: str = "cpu", px: int = 640
) -> tuple[list[Setting], list[str]]:
    return profile.settings(
        matchers=matchers, scales=scales, threads=threads, working_px=px, max_keypoints=1000, provider=provider
    )


# -- what is measured ----------------------------------------------------------------------------------------------


def test_a_scale_of_structural_matching_is_a_rung_with_that_detail_or_more() -> None:
    found, merged = asked(["structural"], [0.3, 1.0, 0.75, 0.5, 0.6], (1, 2))
    assert [(one.scale, one.rung, one.working_px, one.px, one.threads) for one in found] == [
        (1.0, 0, None, "512", 1), (0.75, 1, None, "384", 1), (0.5, 2, None, "256", 1),
    ]  # fmt: skip
    assert merged == [
        "structural has no detail of 0.6; it is measured as 0.75",
        "structural has no detail of 0.3; it is measured as 0.5",
    ]


def test_a_scale_of_features_is_a_size_that_the_network_takes() -> None:
    found, merged = asked(["xfeat", "sift"], [1.0, 0.55, 0.3], (1, 2), "openvino")
    assert [(one.matcher, one.working_px, one.threads, one.provider) for one in found] == [
        ("xfeat", 640, 1, "openvino"), ("xfeat", 352, 1, "openvino"), ("xfeat", 192, 1, "openvino"),
        ("xfeat", 640, 2, "openvino"), ("xfeat", 352, 2, "openvino"), ("xfeat", 192, 2, "openvino"),
        ("sift", 640, 1, "cpu"), ("sift", 352, 1, "cpu"), ("sift", 192, 1, "cpu"),
    ]  # fmt: skip
    assert (found[1].scale, merged) == (0.55, [])
    both, _ = asked(["structural+sift"], [0.5])
    assert (both[0].rung, both[0].working_px, both[0].px) == (2, 320, "256 + 320")
    # A network whose picture has a size of its own.
    fixed, merged = asked(["mast3r"], [1.0, 0.5])
    assert [(one.scale, one.working_px, one.label) for one in fixed] == [(1.0, None, "mast3r at its own px")]
    assert merged == ["mast3r has no detail of 0.5; it is measured as 1"]
    with pytest.raises(ConfigError, match=r"scale 0\.1 of --working-px 640 is 64 px; .* needs 128"):
        asked(["xfeat"], [0.1])


def test_more_processes_than_anyone_means_are_refused() -> None:
    with pytest.raises(ConfigError, match="25 settings at once"):
        asked(["xfeat"], [1.0, 0.9, 0.8, 0.7, 0.6], (1, 2, 3, 4, 5))


def test_each_setting_begins_equally_often() -> None:
    assert [profile._turn(step, 3) for step in range(4)] == [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 1, 2]]


# -- summed up -----------------------------------------------------------------------------------------------------


def flown(wall_ms: float, te_m: float | None = 0.1, x: float | None = None) -> Flown:
    fixed = te_m is not None or x is not None
    return Flown(
        timings_ms={"match": wall_ms / 2, "total": wall_ms},
        wall_ms=wall_ms,
        cpu_ms=wall_ms / 4,
        rss_mb=100.0 + wall_ms,
        peak_mb=200.0,
        position_m=(x or 0.0, 0.0, 0.0) if fixed else None,
        te_m=te_m,
        re_deg=None if te_m is None else 0.2,
    )


def test_the_first_frames_are_not_timed_but_judged() -> None:
    steps = [flown(900.0, 20.0), flown(10.0), flown(20.0, None), flown(30.0, 2.0)]
    (row,) = profile.rows([FULL], [BEGUN], [steps], 1)
    assert (row.frames, row.timed, row.fixes, row.first_ms) == (4, 3, 3, 900.0)
    assert row.frame_ms == Latency(20.0, 29.0, 29.8)
    assert row.stages_ms["match"] == Latency(10.0, 14.5, 14.9)
    assert (row.cpu_ms.median, row.rss_mb, row.peak_mb) == (5.0, 120.0, 200.0)
    assert row.accuracy is not None
    assert (row.accuracy.te_m.median, row.accuracy.false_fixes) == (2.0, 1)
    assert row.accuracy.recall == {"1m_1deg": 0.25, "3m_3deg": 0.5, "5m_5deg": 0.5}
    assert row.agreement is None


def test_without_truth_settings_are_held_against_full_detail() -> None:
    begun = replace(BEGUN, truth=False)
    full = [flown(9.0, None, 1.0), flown(9.0, None, 2.0), flown(9.0, None, 3.0), flown(9.0, None)]
    half = [flown(5.0, None, 1.5), flown(5.0, None, 2.1), flown(5.0, None), flown(5.0, None)]
    first, second = profile.rows([FULL, HALF], [begun, begun], [full, half], 0)
    assert (first.accuracy, first.agreement, second.accuracy) == (None, None, None)
    assert second.agreement is not None
    assert second.agreement.same_verdict == 0.75
    assert second.agreement.apart_m.median == pytest.approx(0.3)
    # Another matcher has a full detail of its own.
    other = replace(HALF, matcher="sift", working_px=320)
    assert profile.rows([FULL, other], [begun, begun], [full, half], 0)[1].agreement is None


# -- recommended ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Made:
    """A row's figures that count here."""

    setting: Setting
    p99_ms: float
    recall: float = 1.0
    p90_m: float | None = 0.2
    false: int = 0
    cpu_ms: float = 50.0
    median_ms: float = 60.0


def row(made: Made) -> profile.Row:
    none = Spread(None, None, None, None)
    error = none if made.p90_m is None else Spread(made.p90_m / 2, made.p90_m, made.p90_m, made.p90_m)
    return profile.Row(
        setting=made.setting, frames=100, timed=97, fixes=100, load_ms=1.0, warm_up_ms=2.0, first_ms=3.0,
        frame_ms=Latency(made.median_ms, made.p99_ms, made.p99_ms), stages_ms={"total": Latency(1.0, 2.0, 3.0)},
        cpu_ms=Latency(made.cpu_ms, made.cpu_ms, made.cpu_ms), rss_mb=100.0, peak_mb=120.0,
        accuracy=profile.Accuracy(
            te_m=error, re_deg=error, recall={"1m_1deg": made.recall, "3m_3deg": 1.0}, false_fixes=made.false
        ),
        agreement=None,
    )  # fmt: skip


XFEAT = Setting("structural+xfeat", 1.0, 2, "openvino", 0, 640, 2048)
TEN = profile.Bounds(rate_hz=10.0)


@pytest.mark.parametrize(
    ("rows", "best"),
    [
        ([Made(FULL, 99.0), Made(HALF, 50.0)], 0),  # the detail, where there is time for it
        ([Made(FULL, 100.0), Made(HALF, 50.0)], 1),  # the limit itself is too long
        ([Made(FULL, 90.0, cpu_ms=70.0), Made(XFEAT, 90.0, cpu_ms=60.0)], 1),  # the cheaper of those alike
        ([Made(FULL, 150.0), Made(HALF, 50.0, recall=0.97)], None),  # too many frames lost
        ([Made(FULL, 150.0, recall=0.9), Made(HALF, 50.0, recall=0.89)], 1),  # the best is no better
        ([Made(FULL, 150.0), Made(HALF, 50.0, p90_m=1.1)], None),
        ([Made(FULL, 150.0), Made(HALF, 50.0, p90_m=None)], None),
        ([Made(FULL, 150.0), Made(HALF, 50.0, false=1)], None),
        ([Made(FULL, 150.0, false=1), Made(HALF, 50.0, false=1)], 1),
    ],
)
def test_what_keeps_the_bounds(rows: list[Made], best: int | None) -> None:
    found = profile.recommend([row(one) for one in rows], TEN)
    assert found.row == best
    assert bool(found.config) == (best is not None)


def test_none_is_recommended_with_what_the_fastest_lacks() -> None:
    found = profile.recommend([row(Made(FULL, 250.0)), row(Made(HALF, 120.0, false=2))], TEN)
    assert found.row is None
    assert "structural at 256 px: 99 of 100 frames take 120 ms, 100 are allowed; 2 false fixes" in found.why


def test_the_recommended_lines_are_the_daemons() -> None:
    found = tomllib.loads(profile.recommend([row(Made(XFEAT, 80.0))], TEN).config)
    assert found == {
        "matcher": {
            "name": "structural+xfeat", "working_px": 640, "max_keypoints": 2048, "threads": 2, "provider": "openvino",
        },
        "timing": {"budget_ms": 100.0},
    }  # fmt: skip
    assert set(found["matcher"]) <= set(MatcherOptions.__struct_fields__)
    # Between the two rungs' times, so that the daemon takes the lower and stays on it.
    above = Setting("structural", 0.75, 1, "cpu", 1, None, 4096)
    rows = [row(Made(above, 140.0, median_ms=80.0)), row(Made(HALF, 70.0, median_ms=45.0))]
    lower = profile.recommend(rows, TEN)
    assert lower.row == 1
    assert tomllib.loads(lower.config)["timing"]["budget_ms"] == pytest.approx(60.0)


def test_without_truth_the_bounds_are_full_details() -> None:
    def judged(same: float, p90: float) -> profile.Row:
        apart = Spread(p90 / 2, p90, p90, p90)
        return replace(
            row(Made(HALF, 50.0)), accuracy=None, agreement=profile.Agreement(same_verdict=same, apart_m=apart)
        )

    full = replace(row(Made(FULL, 150.0)), accuracy=None)
    for other, best in ((judged(1.0, 0.5), 1), (judged(0.97, 0.5), None), (judged(1.0, 1.2), None)):
        assert profile.recommend([full, other], TEN).row == best
    assert profile.recommend([replace(full, frame_ms=Latency(1.0, 2.0, 3.0))], TEN).row == 0


# -- the command ---------------------------------------------------------------------------------------------------

PACK = rendered.store().pack.path


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    # Those of the commands' tests: rendered once.
    poses = [rendered.pose(), rendered.pose(318.0, 262.0, yaw_deg=34.0, roll_deg=4.0)]
    return rendered.write_flight(tmp_path_factory.mktemp("flight"), poses)


def test_a_flight_profiled(flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--frames", str(flight), "--pack", str(PACK), "--scales", "1,0.5,0.3", "--passes", "2", "--warm-up", "1"]
    assert main(["profile", *words, "--rate", "0.01", "--json", "--out", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [(one["setting"]["scale"], one["frames"], one["timed"]) for one in found["rows"]] == [(1, 4, 3), (0.5, 4, 3)]
    for one in found["rows"]:
        assert one["fixes"] == 4
        assert one["accuracy"]["recall"]["1m_1deg"] == 1.0
        assert 0 < one["accuracy"]["te_m"]["median"] < 1.0
        assert {"map_window", "match", "structural", "total"} <= set(one["stages_ms"])
        assert 0 < one["stages_ms"]["total"]["median"] <= one["frame_ms"]["median"]
        assert 40 < one["rss_mb"] <= one["peak_mb"]
    # Other detail, other poses: the two were not the same run.
    assert found["rows"][0]["accuracy"]["te_m"] != found["rows"][1]["accuracy"]["te_m"]
    assert found["recommendation"]["row"] == 0
    assert found["waited"] > 0
    assert found["merged"] == ["structural has no detail of 0.3; it is measured as 0.5"]
    assert json.loads((tmp_path / "profile.json").read_text()) == found
    text = (tmp_path / "profile.md").read_text()
    assert "| structural | 0.5 | 256 | - |" in text
    assert 'name = "structural"' in text
    # One table's rows are as long as its heading.
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len({line.count("|") for line in table[:4]}) == 1
    svg = (tmp_path / "profile.svg").read_text()
    assert ET.fromstring(svg).tag == "{http://www.w3.org/2000/svg}svg"
    assert "http" not in svg.replace("http://www.w3.org/2000/svg", "")


def test_a_plot_of_what_has_nothing_to_compare() -> None:
    """One setting, no fix, no rate; and names that markup would misread."""
    lost = replace(row(Made(FULL, 0.4, p90_m=None)), fixes=0)
    measured = profile.Profile(
        measured="m", load=(0.0, 0.1), waited=None, source="<a&b>", pack="p", prior="odometer", seed=0, passes=1,
        warm_up_frames=0, merged=[], rows=[lost], recommendation=None,
    )  # fmt: skip
    assert "&lt;a&amp;b&gt;" in profile_svg(measured)
    ET.fromstring(profile_svg(measured))
    assert "| - / - |" in profile.markdown(measured)
    assert "busy" not in profile.markdown(measured)


def test_a_busy_machine_is_told_by_the_time_that_frames_waited() -> None:
    idle, busy = row(Made(FULL, 90.0, cpu_ms=60.0)), row(Made(HALF, 90.0, cpu_ms=20.0))
    assert profile.waited([busy]) == 3.0
    # What one setting could do, the machine can.
    assert profile.waited([busy, idle]) == 1.0
    # A frame may wait for another device.
    assert profile.waited([replace(busy, setting=XFEAT)]) is None
    said = profile.Profile(
        measured="m", load=(9.0, 9.0), waited=3.0, source="s", pack="p", prior="odometer", seed=0, passes=1,
        warm_up_frames=3, merged=[], rows=[busy], recommendation=None,
    )  # fmt: skip
    assert "frames took 3.0 times their processor time" in profile.markdown(said)


@pytest.mark.parametrize(
    ("more", "code", "words"),
    [
        ([], EXIT_CONFIG, "--pack is missing"),
        (["--pack", str(PACK), "--provider", "openvino"], EXIT_CONFIG, "provider|runs a network"),
        (["--pack", str(PACK), "--passes", "1", "--warm-up", "2"], EXIT_CONFIG, "nothing is left; give more --passes"),
        (["--pack", "/none"], EXIT_FAILED, "structural at 512 px: .*none"),
    ],
)
def test_what_cannot_be_profiled(
    flight: Path, more: list[str], code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["profile", "--frames", str(flight), "--scales", "1", *more]) == code
    assert re.search(words, capsys.readouterr().err)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--scales", "1,2"], "'2' is not a scale from 0.05 to 1"),
        (["--matcher", "surf"], "'surf' is not one of structural"),
        (["--threads", "0"], "'0' is below 1"),
    ],
)
def test_usage(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["profile", "--frames", "x", *words])
    assert stop.value.code == 2
    assert said in capsys.readouterr().err


def test_a_process_that_dies_is_an_error_that_names_the_setting(flight: Path) -> None:
    with ProfileProcess(FULL, Source(flight=str(flight), pack=str(PACK))) as process:
        process.step()
        process._process.kill()
        with pytest.raises(OrtholocError, match=r"structural at 512 px: its process ended with status -9"):
            process.step()


def test_too_little_memory_for_all_is_said_before_it_is_used(monkeypatch: pytest.MonkeyPatch, flight: Path) -> None:
    monkeypatch.setattr(profile, "available_mb", lambda: 70.0)
    with pytest.raises(OrtholocError, match=r"1 of 2 settings leave 70 MB of memory, and one takes up to \d+"):
        profile.measure(
            [FULL, HALF], Source(flight=str(flight), pack=str(PACK)), passes=1, warm_up_frames=0,
            progress=lambda done, steps: None,
        )  # fmt: skip
