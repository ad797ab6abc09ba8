"""Every shipped scenario in its short form; the same flight twice gives the same bytes; files that can't be flown."""

from __future__ import annotations

import dataclasses
import html
import json
import logging
import math
import os
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import msgspec
import numpy as np
import pytest
from ortholoc_sim.gnss import GnssEvent, gnss_at
from ortholoc_sim.judgement import FRAMES, RESULT, TRACK, Judged, judge, write_files
from ortholoc_sim.line import End, Line, LineOptions
from ortholoc_sim.lockstep import Flown, fly
from ortholoc_sim.loop import STEP_NS
from ortholoc_sim.report_page import write_page
from ortholoc_sim.rounded import rounded
from ortholoc_sim.scenario import Expectations, find_scenario, read_scenario, shipped
from ortholoc_sim.stage import Studio, make_grounds

from ortholoc_edge.cli import main
from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry import frames
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.outcome import Fix

MS, S = 1_000_000, 1_000_000_000
# Those over the same ground one after the other: it is made once.
NAMES = sorted(shipped(), key=lambda name: read_scenario(find_scenario(name)).map.kind)
REPORT = "report.html"

Flight = Callable[[str], Flown]


@pytest.fixture(scope="session")
def packs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("scenario_packs")


@pytest.fixture(scope="session")
def flight(packs: Path) -> Flight:
    """Fly a scenario's short form; each once."""
    return cache(lambda name: fly(read_scenario(find_scenario(name), short=True), 1, packs))


@pytest.mark.parametrize("name", NAMES)
def test_scenario_comes_out_as_expected(name: str, flight: Flight) -> None:
    result = judge(flight(name)).result
    assert result.passed, result.problems
    assert result.false_fixes == 0


@pytest.mark.parametrize("name", NAMES)
def test_the_long_form_reads(name: str) -> None:
    long, short = (read_scenario(find_scenario(name), short) for short in (False, True))
    if long.world.pack is None:
        assert long.world.width_m * long.world.height_m > 1e6
        assert short.world.width_m < long.world.width_m
    # A scenario that expects nothing shows nothing.
    assert long.expect != Expectations()


def test_same_scenario_and_seed_same_bytes(flight: Flight, packs: Path, tmp_path: Path) -> None:
    """In another process, with another order of its hashes and another number of threads, and by the command."""
    judged = judge(flight("gnss_lost"))
    write_files(judged, tmp_path / "here")
    write_page(judged, tmp_path / "here" / REPORT)
    command = [sys.executable, "-m", "ortholoc_edge", "sim", "--scenario", "gnss_lost", "--short", "--json", "--out",
               str(tmp_path / "there"), "--packs", str(packs)]  # fmt: skip
    environment = {**os.environ, "PYTHONHASHSEED": "7", "OMP_NUM_THREADS": "1",
                   "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}  # fmt: skip
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
    assert run.returncode == 0, run.stderr
    there = tmp_path / "there" / "gnss_lost" / "seed-1"
    for name in (RESULT, FRAMES, TRACK, REPORT):
        assert (tmp_path / "here" / name).read_bytes() == (there / name).read_bytes(), name
    (printed,) = json.loads(run.stdout)
    assert printed["passed"] is True and printed["scenario"] == "gnss_lost"
    assert "gnss_lost/seed-1/report.html" in (tmp_path / "there" / "index.html").read_text()


def test_a_flight_over_a_map_itself_says_so(flight: Flight, tmp_path: Path) -> None:
    judged = judge(flight("over_a_map"))
    assert judged.result.notice is not None and "own orthophoto" in judged.result.notice
    write_page(judged, tmp_path / REPORT)
    assert judged.result.notice in html.unescape((tmp_path / REPORT).read_text())
    assert judge(flight("gnss_lost")).result.notice is None


def test_over_a_pack_its_size_counts_and_no_other_map(tmp_path: Path, packs: Path) -> None:
    text = find_scenario("over_a_map").read_text()
    far = tmp_path / "far.toml"
    far.write_text(text.replace("[[120, 250], [330, 250]]", "[[120, 250], [3300, 250]]"))
    with pytest.raises(ConfigError, match=r"waypoint \(3300, 250\) lies outside the ground of 6\d\d x 5\d\d m"):
        fly(read_scenario(far, short=True), 1, packs)
    both = tmp_path / "both.toml"
    both.write_text(text + '\n[map]\nkind = "xDOP"\n')
    with pytest.raises(ConfigError, match="the map is that pack"):
        read_scenario(both)
    gone = tmp_path / "gone.toml"
    gone.write_text(text.replace('"demo"', f'"{tmp_path}/no_pack"'))
    with pytest.raises(MapError, match="no_pack"):
        fly(read_scenario(gone, short=True), 1, packs)


def test_another_seed_is_another_flight(packs: Path, flight: Flight) -> None:
    scenario = read_scenario(find_scenario("without_fixes"), short=True)
    other = fly(scenario, 2, packs).loop.samples[-1].truth.position_ned_m
    assert np.abs(other - flight("without_fixes").loop.samples[-1].truth.position_ned_m).max() > 0.1


# -- what they show ----------------------------------------------------------


def test_faults_happen_when_they_should(flight: Flight) -> None:
    def refused(name: str) -> list[float]:
        return [frame.t_s for frame in flight(name).frames if not isinstance(frame.outcome, Fix)]

    for name, kind in (("frames_black", "frames_black"), ("water_only", "frames_of_water"),
                       ("autopilot_mute", "autopilot_mute")):  # fmt: skip
        (fault,) = (fault for fault in flight(name).scenario.fault if fault.kind == kind)
        assert fault.until_s is not None
        times = refused(name)
        # A silence is noticed with the first attitude that is missing, and ends with the streams' return.
        assert times and min(times) >= fault.from_s - 0.2 and max(times) < fault.until_s + 1.5, (name, times)
    stalled = [frame.t_s for frame in flight("camera_stalls").frames]
    (fault,) = flight("camera_stalls").scenario.fault
    assert fault.until_s is not None
    assert max(np.diff(stalled)) >= fault.until_s - fault.from_s - 0.7
    assert flight("computer_slow").replaced > 0
    assert flight("line_lossy").line["lost"] > 20
    assert "lost" not in flight("gnss_lost").line
    assert 50.0 < float(flight("line_round_trip").statistics["link.round_trip_ms"] or 0.0) < 70.0
    # The line takes 2.8 ms for a heartbeat alone; a socket's round trip is 2 to 3 ms.
    assert float(flight("line_57600").statistics["link.round_trip_ms"] or 0.0) > 8.0
    assert flight("clock_steps").statistics["link.sync_resets"] == 1
    twice = [frame.t_s for frame in flight("frames_disordered").frames]
    assert len(twice) > len(set(twice))
    assert int(flight("map_damaged").statistics["map_files_damaged"] or 0) == 2


def test_a_spoofer_leads_the_autopilot_and_not_the_camera(flight: Flight) -> None:
    judged = judge(flight("gnss_spoofed"))
    assert judged.autopilot_m[-1] > 8.0
    assert max(float(np.linalg.norm(errors.step_m)) for errors in judged.errors if errors is not None) < 1.0


# -- judgement ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("expect", "problem"),
    [
        (Expectations(route_p95_m=0.01), "of the route; limit 0.01 m"),
        (Expectations(lost_m=500.0), "should be lost by 500 m"),
        (Expectations(fixed=(0.0, 0.5)), "frames gave a fix; expected 0% to 50%"),
        (Expectations(nees=(50.0, 60.0)), "mean NEES"),
        (Expectations(reasons=("late",)), "no frame was refused as late"),
        (Expectations(says=("GNSS contradicts",)), "nothing was said of 'GNSS contradicts'"),
        (Expectations(verdicts=("gated",)), "verdict gated never occurred"),
        (Expectations(), None),
    ],
)
def test_each_expectation_can_fail(expect: Expectations, problem: str | None, flight: Flight) -> None:
    flown = flight("gnss_lost")
    plain = msgspec.convert(msgspec.to_builtins(expect), Expectations)  # reasons as the values that a file gives
    result = judge(dataclasses.replace(flown, scenario=msgspec.structs.replace(flown.scenario, expect=plain))).result
    assert result.passed is (problem is None)
    assert problem is None or any(problem in found for found in result.problems), result.problems


@pytest.mark.parametrize(
    ("name", "expect", "problem"),
    [
        ("clock_steps", Expectations(says_not=("fixes fused",)), "'fixes fused' was said"),
        ("without_fixes", Expectations(fused=0.5), "the autopilot took in nothing of what it received"),
    ],
)
def test_what_the_first_flight_does_not_show_can_fail(
    name: str, expect: Expectations, problem: str, flight: Flight
) -> None:
    flown = flight(name)
    scenario = msgspec.structs.replace(flown.scenario, expect=expect)
    result = judge(dataclasses.replace(flown, scenario=scenario)).result
    assert any(problem in found for found in result.problems), result.problems


def test_a_false_fix_is_counted(flight: Flight) -> None:
    flown = flight("gnss_lost")
    frame = flown.frames[3]
    assert isinstance(frame.outcome, Fix)
    pose = frame.outcome.map_from_camera
    moved = dataclasses.replace(
        frame.outcome, map_from_camera=Rigid3(pose.rotation, pose.translation + np.array([9.5, 0.0, 0.0]))
    )
    frames_ = (*flown.frames[:3], dataclasses.replace(frame, outcome=moved), *flown.frames[4:])
    result = judge(dataclasses.replace(flown, frames=frames_)).result
    assert result.false_fixes == 1  # beyond a tenth of 90 m
    assert not result.passed and "1 false fixes; at most 0" in result.problems
    assert result.position_m.max == pytest.approx(9.5, abs=0.2)


def test_distances_are_as_they_are(flight: Flight) -> None:
    """The truth on file, the autopilot's error and the distance from the route agree with each other."""
    judged: Judged = judge(flight("gnss_lost"))
    apart = np.linalg.norm((judged.believed_map_m - judged.true_map_m)[:, :2], axis=1)
    assert judged.autopilot_m == pytest.approx(apart, abs=0.02)
    (a, b), here = judged.flown.route_map_m[:2, :2], judged.true_map_m[40, :2]
    across = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
    assert judged.route_m[40] == pytest.approx(abs(float((here - a) @ across)), abs=1e-3)


# -- report ------------------------------------------------------------------


class _References(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.found += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "data")]


def test_the_page_needs_nothing_else(flight: Flight, tmp_path: Path) -> None:
    judged = judge(flight("map_hole"))
    write_page(judged, tmp_path / REPORT)
    text = (tmp_path / REPORT).read_text()
    page = _References()
    page.feed(text)
    assert page.found and all(found.startswith("data:image/jpeg;base64,") for found in page.found)
    assert "script" not in page.tags and "link" not in page.tags and "url(" not in text
    pictures = re.findall(r"<svg .*?</svg>", text, re.S)
    assert len(pictures) == 6  # the map, four charts, what frames came to
    for picture in pictures:
        root = ET.fromstring(picture)
        width, height = (float(root.attrib[side]) for side in ("width", "height"))
        for line in root.iter("polyline"):
            points = np.array([[float(v) for v in pair.split(",")] for pair in line.attrib["points"].split()])
            assert np.isfinite(points).all() and (points >= -5).all() and (points <= (width + 5, height + 5)).all()
    assert text.count("<figure>") == sum(frame.picture is not None for frame in judged.flown.frames)
    assert judged.result.title in text and "as expected" in text


def test_the_map_shows_the_flight_where_it_was(flight: Flight, tmp_path: Path) -> None:
    """It goes east, so its line goes to the right, and the dots of the fixes lie on it."""
    judged = judge(flight("gnss_lost"))
    write_page(judged, tmp_path / REPORT)
    root = ET.fromstring(re.search(r"<svg .*?</svg>", (tmp_path / REPORT).read_text(), re.S).group())  # type: ignore[union-attr]
    lines = [np.array([[float(v) for v in pair.split(",")] for pair in line.attrib["points"].split()])
             for line in root.iter("polyline")]  # fmt: skip
    truth = lines[-1]
    assert truth[-1, 0] - truth[0, 0] > 50 and abs(truth[-1, 1] - truth[0, 1]) < 20
    dots = np.array([(float(dot.attrib["cx"]), float(dot.attrib["cy"])) for dot in root.iter("circle")
                     if dot.attrib["r"] == "3.2"])  # fmt: skip
    assert len(dots) == judged.result.fixes
    nearest = np.linalg.norm(dots[:, None] - truth[None], axis=2).min(axis=1)
    assert nearest.max() < 8.0


# -- files -------------------------------------------------------------------

GOOD = """
title = "x"
[route]
waypoints_m = [[100, 100], [200, 100]]
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("title = ", "not TOML"),
        ('title = "x"', "missing required field `route`"),
        (GOOD + "[camra]\nrate_hz = 2", "unknown field `camra`"),
        (GOOD + "speed = 3", "unknown field `speed` - at `$.route`"),
        (GOOD + '[[fault]]\nkind = "rain"', "Invalid enum value 'rain' - at `$.fault[0].kind`"),
        (GOOD + '[[fault]]\nkind = "frames_late"', "needs an amount"),
        (GOOD + '[[fault]]\nkind = "frames_black"\namount = 3', "takes no amount"),
        (GOOD + '[[gnss]]\nkind = "lost"\nfrom_s = 9\nuntil_s = 4', "until_s = 4 is not after from_s = 9"),
        (GOOD + '[link]\nendpoint = "udp:0.0.0.0:1"', "the simulated line is in [line]"),
        (GOOD + "[link]\nset_orgin = true", "unknown field `set_orgin` - at `$.link`"),
        (GOOD + '[map]\nkind = "snow"', "Invalid enum value 'snow'"),
        (GOOD + '[mount]\npreset = "forward"\ngimbal = "auto"', "without a [gimbal] table"),
        (GOOD.replace("200, 100", "2000, 100"), "waypoint (2000, 100) lies outside the world of 1200 x 1000 m"),
        (GOOD + '[expect]\nreasons = ["fog"]', "Invalid enum value 'fog'"),
        (GOOD + "[latency]\np99_ms = 10", "p99_ms = 10 is below median_ms"),
        ('name = "y"' + GOOD, "a scenario's name is its file's"),
    ],
)
def test_files_that_cannot_be_flown(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_scenario(path)
    assert message in str(caught.value) and str(path) in str(caught.value)


def test_a_file_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text(GOOD + "[short]\nroute = { speed_m_s = 5 }\n")
    scenario = read_scenario(path)
    assert (scenario.name, scenario.route.speed_m_s) == ("own", 12.0)
    short = read_scenario(path, short=True)
    assert short.route.speed_m_s == 5.0 and short.route.waypoints_m == scenario.route.waypoints_m
    path.write_text(GOOD)
    with pytest.raises(ConfigError, match=r"no \[short\] table"):
        read_scenario(path, short=True)


def test_names_that_are_none(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sim", "--scenario", "gnss_lots"]) == 78
    assert "neither a file nor one of" in capsys.readouterr().err
    assert main(["sim", "--list-scenarios"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == sorted(NAMES)


def test_options_of_scenarios_need_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = logging.getLogger("ortholoc_edge").level
    for option in ("--without-fixes", "--short", "--seeds=2", f"--packs={tmp_path}"):
        assert main(["sim", option]) == 78
        assert "is of scenarios; name one with --scenario" in capsys.readouterr().err
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "own.toml").write_text(GOOD)
    twice = [f"--scenario={tmp_path / folder / 'own.toml'}" for folder in ("a", "b")]
    assert main(["sim", *twice, "--out", str(tmp_path / "out")]) == 78
    assert "several scenarios are named own" in capsys.readouterr().err
    # Flights are quiet; what runs after them in the same process is not.
    assert logging.getLogger("ortholoc_edge").level == before


def test_faults_that_happen_once_happen_each(packs: Path) -> None:
    scenario = read_scenario(find_scenario("clock_steps"), short=True)
    step = msgspec.structs.replace(scenario.fault[0], from_s=3.0)
    several = msgspec.structs.replace(scenario, fault=(step, msgspec.structs.replace(step, from_s=4.5), step))
    flown = fly(several, 1, packs)
    once_ms = step.amount or 0.0
    assert flown.loop.boot_ns(0) - flown.loop.options.autopilot.boot_offset_ns == pytest.approx(
        3 * once_ms * MS - (flown.loop.samples[0].stamp_ns - STEP_NS), abs=1
    )


# -- parts -------------------------------------------------------------------


def test_gnss_events() -> None:
    events = (
        GnssEvent(kind="spoofed", from_s=10.0, rate_m_s=2.0, towards_deg=90.0),
        GnssEvent(kind="jammed", from_s=30.0, until_s=50.0),
    )
    assert gnss_at(events, 5.0).available and not gnss_at(events, 5.0).offset_ned_m.any()
    assert gnss_at(events, 15.0).offset_ned_m == pytest.approx([0.0, 10.0, 0.0])
    onset = gnss_at(events, 33.0)
    assert onset.available and onset.noise > 5.0
    assert not gnss_at(events, 40.0).available
    assert gnss_at(events, 51.0).available


def test_a_line_delays_loses_and_is_as_fast_as_its_baud_rate() -> None:
    line = Line(LineOptions(delay_ms=25.0, jitter_ms=0.0), 1)
    assert line.wires[End.AUTOPILOT].send(b"x" * 100, 5 * S)
    assert line.next_ns() == 5 * S + 25 * MS
    assert line.take() == (End.AUTOPILOT, b"x" * 100)
    assert line.next_ns() is None
    slow = Line(LineOptions(delay_ms=0.0, jitter_ms=0.0, baud=57_600), 1)
    wire = slow.wires[End.COMPANION]
    assert wire.send(b"x" * 576, 0) and slow.next_ns() == 100 * MS
    assert wire.waiting_bytes(50 * MS) == 288
    # What waits to be written is bounded, and the other direction has a wire of its own.
    sent = [wire.send(b"x" * 576, 0) for _ in range(6)]
    assert sent == [True, True, False, False, False, False] and slow.counts["refused"] == 4
    assert slow.wires[End.AUTOPILOT].send(b"x", 0)
    lossy = Line(LineOptions(loss=0.25, jitter_ms=20.0), 3)
    for k in range(4000):
        lossy.wires[End.AUTOPILOT].send(bytes([k % 256]), k * MS)
    assert lossy.counts["lost"] == pytest.approx(1000, abs=100)
    arrivals = []
    while (now_ns := lossy.next_ns()) is not None:
        arrivals.append(now_ns)
        lossy.take()
    assert arrivals == sorted(arrivals)
    lossy.wires[End.AUTOPILOT].down = True
    lossy.wires[End.AUTOPILOT].send(b"x", 9 * S)
    assert lossy.next_ns() is None


def test_corners_become_arcs() -> None:
    square = np.array([[0.0, 0.0], [400.0, 0.0], [400.0, 300.0]])
    route = rounded(square, 100.0)
    assert route[0] == pytest.approx(square[0]) and route[-1] == pytest.approx(square[-1])
    centre = np.array([300.0, 100.0])
    assert np.linalg.norm(route[1:-1] - centre, axis=1) == pytest.approx(100.0)
    assert route[1] == pytest.approx([300.0, 0.0]) and route[-2] == pytest.approx([400.0, 100.0])
    steps = np.diff(route, axis=0)
    turns = np.abs(np.diff(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))))
    assert turns.max() < math.radians(8.0)
    # Where a leg is too short the arc is smaller, and what is straight stays so.
    assert np.linalg.norm(np.diff(rounded(square, 1e4), axis=0), axis=1).min() > 1.0
    straight = np.array([[0.0, 0.0], [10.0, 0.0], [20.0, 0.0]])
    assert rounded(straight, 5.0) == pytest.approx(straight)


def test_a_rolling_shutter_shows_each_row_from_where_it_was() -> None:
    scenario = read_scenario(find_scenario("rolling_shutter"), short=True)
    grounds = make_grounds(scenario.world, scenario.map.kind)
    studio = Studio(grounds, msgspec.structs.replace(scenario.camera, noise=0.0, jpeg_quality=0))
    times = studio.row_times_ms()
    assert times[0] < 0 < times[-1] and times[-1] - times[0] == pytest.approx(15.0 * 11 / 12)
    eye = np.append(grounds.low_m + 200.0, grounds.ground_m + 90.0)
    pose = Rigid3(frames.map_from_ned_rotation(0.0) @ frames.BODY_FROM_NADIR_CAMERA, eye)
    moved = [Rigid3(pose.rotation, eye + np.array([0.0, 0.3 * t_ms, 0.0])) for t_ms in times]
    still, rolling = (studio.picture(poses, None, 1).astype(int) for poses in ([pose] * len(times), moved))
    middle = studio.camera.height // 2
    difference = np.abs(still - rolling).mean(axis=(1, 2))
    assert difference[middle - 5 : middle + 5].mean() < 0.5 * difference[:20].mean()
    # A shutter that opens for longer smears.
    smeared = studio.picture([pose] * len(times), (moved[0], moved[-1]), 1).astype(int)
    assert np.abs(np.diff(smeared, axis=0)).mean() < 0.8 * np.abs(np.diff(still, axis=0)).mean()
