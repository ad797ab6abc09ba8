"""The page in a real Chromium, fed by the daemon's own thread: what a pilot sees, and above all when it is old."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest
from chromium import Chromium, Tab, chromium, find
from ortholoc_sim import demo_pack_path

from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.adapters.messages import AutopilotMessage, CommandReply, SearchFor
from ortholoc_edge.adapters.page.ground_page import GroundPage, Health, LeaveCommand
from ortholoc_edge.adapters.page.options import Listen
from ortholoc_edge.adapters.page.report import FlightRecord
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.navigator import Circumstances
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore
from page.test_page_marks import CAMERA, NADIR, a_fix, down

HOSTILE = "</script><img src=x onerror=document.title='owned'>"


class Feeder:
    """Leaves for the page what a daemon would."""

    def __init__(self, store: MapStore, listen: Listen, leave: LeaveCommand | None = None) -> None:
        self.clock = SystemClock()
        self.page = GroundPage(
            listen, self.clock, store, CAMERA, NADIR, {"matcher": "structural", "vehicle": "hawk"}, leave
        )
        west, south, east, north = store.bounds
        self.middle = np.array([(west + east) / 2, (south + north) / 2, 400.0])
        self.frames = 0

    def pose(self, east_m: float, north_m: float) -> Rigid3:
        turn = rotation.from_euler(0.0, 0.0, np.pi / 2)
        return Rigid3(
            frames.map_from_ned_rotation(0.0) @ turn @ frames.BODY_FROM_NADIR_CAMERA,
            self.middle + np.array([east_m, north_m, 90.0]),
        )

    def put(self, outcome: Outcome, pose: Rigid3, age_s: float = 0.0) -> None:
        stamp_ns = self.clock.now_ns() - round(age_s * 1e9)
        self.frames += 1
        image = np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
        image[:, : CAMERA.width // 2] = (20, 160, 60)
        prior = PosePrior(pose, np.eye(6) * 9.0)
        state = VehicleState(
            stamp_ns, np.eye(3), (0.1, 0.1, 0.1), believed_map_m=pose.translation + np.array([4.0, 0.0, 0.0])
        )
        self.page.put(
            Frame(stamp_ns, image, str(self.frames)), _restamped(outcome, stamp_ns), state,
            Circumstances(self.frames, prior, 0, 1, 0),
        )  # fmt: skip

    def fix(self, east_m: float, north_m: float, age_s: float = 0.0) -> None:
        covariance = np.eye(6) * 0.04
        covariance[:2, :2] = [[25.0, 12.0], [12.0, 9.0]]
        pose = self.pose(east_m, north_m)
        low = a_fix(Rigid3(pose.rotation, pose.translation - np.array([0.0, 0.0, 400.0])), covariance)
        shifted = low.points_map + np.array([0.0, 0.0, 400.0])
        self.put(Fix(**{**_fields(low), "map_from_camera": pose, "points_map": shifted}), pose, age_s)

    def reject(self, east_m: float, north_m: float, detail: str = "") -> None:
        self.put(Rejected(0, Reason.LOW_CONTRAST, detail, 4.5, 10.5), self.pose(east_m, north_m))

    def health(
        self, *, connected: bool = True, fusion: str = "fused", trouble: str | None = None, paused: bool = False
    ) -> None:
        now_ns = self.clock.now_ns()
        record = AutopilotMessage(
            stamp_ns=now_ns, unix_ns=0, connected=connected, fusion=fusion, fusion_since_s=1.0, fusion_reason="because",
            gnss="ok", gnss_since_s=1.0, gnss_apart_m=0.5, gnss_height_apart_m=None, latency_median_ms=80.0,
            latency_p99_ms=120.0, delay_advice=None, on_vision=False,
        )  # fmt: skip
        computer = ComputerStatus((40.0, 60.0), 900, 4000, (61.0, 72.4), False, True, False)
        statistics = {"sent": 5, "fixes": 5, "rejected": 1, "map_files_damaged": 0}
        self.page.tell(
            Health(
                now_ns=now_ns, tracker="track", paused=paused, autopilot=record, vehicle="ardupilot 4.6.1",
                trouble=trouble, computer=computer, budget_ms=200.0, rung=1, rungs=5, rate_hz=None,
                rung_why="processor hot, 72 C", statistics=statistics,
            )
        )  # fmt: skip

    def keep(self, seconds: float, tab: Tab, script: str, what: str) -> None:
        """Go on flying until the page shows something."""
        deadline = time.monotonic() + seconds
        while not tab.run(script):
            assert time.monotonic() < deadline, f"{what}: not in {seconds:g} s; the page says {tab.text('body')!r}"
            self.fix(30.0, 0.0)
            self.health()
            time.sleep(0.1)


def _fields(fix: Fix) -> dict[str, object]:
    return {name: getattr(fix, name) for name in Fix.__dataclass_fields__}


def _restamped(outcome: Outcome, stamp_ns: int) -> Outcome:
    kind = type(outcome)
    return kind(**{name: getattr(outcome, name) for name in kind.__dataclass_fields__} | {"stamp_ns": stamp_ns})


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    find()
    with chromium(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.fixture(scope="module")
def store() -> Iterator[MapStore]:
    with MapStore(Pack.open(demo_pack_path())) as opened:
        yield opened


@pytest.fixture
def flying(store: MapStore) -> Iterator[Feeder]:
    feeder = Feeder(store, Listen("127.0.0.1", free_port(), False, None, frozenset()))
    wait(lambda: feeder.page.address is not None)
    yield feeder
    feeder.page.close()


def wait(condition, seconds: float = 10.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_a_flight_on_a_phone(browser: Chromium, flying: Feeder) -> None:
    """All of it, at the width of a small phone: state, figures, map, frame, rejections; and no script of others."""
    for k in range(4):
        flying.fix(10.0 * k, 0.0)
    flying.reject(35.0, 0.0, HOSTILE)
    flying.health()
    tab = browser.tab(360, 640, mobile=True)
    tab.goto(f"{flying.page.address}/")
    flying.keep(20.0, tab, "document.getElementById('state-word').innerText === 'FIX'", "a fix")
    assert "σ 5.61 m" in tab.text("#state"), "the long axis of the ellipse: the root of 17 + sqrt(8² + 12²)"
    assert tab.run("document.documentElement.scrollWidth") <= 360, "nothing sticks out"
    badges = tab.text("#badges")
    assert "link up" in badges and "fixes fused" in badges and "throttled" in badges and "rung 1 of 4" in badges
    figures = tab.text("#figures")
    for words in ("100\n\nof 200 matches", "72 °C", "exposure to sent 80 ms, p99 120 ms", "0.50 m from the last fix"):
        assert words in figures, words
    rejections = tab.text("#rejections")
    assert "the map fits here hardly better" in rejections and "(4.5, limit 10.5)" in rejections
    assert HOSTILE in rejections and tab.run("document.title") == "OrthoLoC", "text stays text"
    assert "match" in tab.text("#stages") and "hawk" in tab.text("#about")
    tab.wait_for("known.picture !== null && [...map.tiles.values()].some((tile) => tile.image)", "pictures")
    green = "(([r, g, b]) => g > r + 60)([...byId('frame').getContext('2d').getImageData(20, 200, 1, 1).data])"
    assert tab.run(green), "the frame is drawn, and left is left"
    smallest = tab.run(
        "Math.min(...[...document.querySelectorAll('body *')].filter((e) => e.offsetParent && e.textContent.trim())"
        ".map((e) => parseFloat(getComputedStyle(e).fontSize)))"
    )
    assert smallest >= 14
    assert tab.console == []


def test_the_map_is_right_in_metres(browser: Chromium, flying: Feeder) -> None:
    """An ellipse's half axes, its turn, and where east is, in pixels of the screen."""
    flying.fix(0.0, 0.0)
    flying.health()
    tab = browser.tab(800, 700)
    tab.goto(f"{flying.page.address}/")
    tab.wait_for("map !== null && map.layers.pose !== null", "a pose on the map")
    shape = tab.run("ellipseOf([25, 12, 9], 2)")
    values, vectors = np.linalg.eigh(np.array([[25.0, 12.0], [12.0, 9.0]]))
    assert [shape["long"], shape["short"]] == pytest.approx((2.0 * np.sqrt(values[::-1])).tolist())
    assert shape["angle"] == pytest.approx(np.arctan2(vectors[1, 1], vectors[0, 1]) % np.pi)
    tab.run("map.setFollows(false); map.centre = [0, 0]; map.scale = 4")
    from_middle = "map((v, k) => v - [map.width / 2, map.height / 2][k])"
    assert tab.run(f"map.toScreen(10, 0).{from_middle}") == pytest.approx([40, 0])
    assert tab.run(f"map.toScreen(0, 10).{from_middle}") == pytest.approx([0, -40])
    assert tab.run("map.toWorld(...map.toScreen(12.5, -7))") == pytest.approx([12.5, -7])
    # The ellipse leans as its covariance does: to the north-east, where the screen's y is smaller.
    along = vectors[:, 1] * np.sign(vectors[0, 1]) * 2.0 * np.sqrt(values[1]) * 0.85
    east, north = along.tolist()
    found = tab.run(f"""(() => {{
      Object.assign(map.layers, {{ track: [], points: [], prior: null, believed: null, gnss: null, old: null,
        pose: {{ at: [0, 0, 0], cov: [25, 12, 9] }} }});
      Object.assign(map, {{ scene: {{ ...map.scene, tiles: null }}, centre: [0, 0], scale: 12 }});
      map.paint();
      const isGreen = (e, n) => {{
        const [x, y] = map.toScreen(e, n).map((v) => Math.round(v * map.ratio));
        const [r, g] = map.canvas.getContext("2d").getImageData(x, y, 1, 1).data;
        return r < 200 && g > r;
      }};
      return [isGreen({east}, {north}), isGreen({east}, {-north}), isGreen({1.3 * east}, {1.3 * north})];
    }})()""")
    assert found == [True, False, False]


def test_zoom_and_pan(browser: Chromium, flying: Feeder) -> None:
    flying.fix(0.0, 0.0)
    tab = browser.tab(400, 800, mobile=True)
    tab.goto(f"{flying.page.address}/")
    tab.wait_for("map !== null && map.layers.pose !== null && zoomed", "a map")
    before = tab.run("map.scale")
    tab.run("byId('zoom-in').click()")
    assert tab.run("map.scale") == pytest.approx(1.6 * before)
    assert tab.run("map.follows")
    for kind, x, y in (("mousePressed", 100, 300), ("mouseMoved", 160, 280), ("mouseReleased", 160, 280)):
        tab.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
    assert not tab.run("map.follows"), "who drags does not want to be dragged back"
    assert tab.run("byId('follow').getAttribute('aria-pressed')") == "false"
    west_south = tab.run("map.centre")
    tab.run("byId('whole').click()")
    assert tab.run("map.centre") != west_south
    tab.run("byId('follow').click()")
    tab.wait_for("Math.hypot(...map.centre.map((v, k) => v - map.layers.pose.at[k])) < 0.01", "back at the vehicle")


def test_an_area_is_drawn_with_a_finger_and_sent(browser: Chromium, store: MapStore) -> None:
    commands: list[SearchFor] = []
    replies = [
        CommandReply(command="search", accepted=True),
        CommandReply(command="search", accepted=False, reason=HOSTILE, remedy="draw it anew"),
    ]

    def leave(command: SearchFor) -> Future[CommandReply]:
        commands.append(command)
        future: Future[CommandReply] = Future()
        future.set_result(replies[len(commands) - 1])
        return future

    # Its own: cookies are of all ports of the host, and the browser is shared.
    token = b"drawn-0123456789abcdef"
    feeder = Feeder(store, Listen("127.0.0.1", free_port(), False, token, frozenset()), leave)
    try:
        wait(lambda: feeder.page.address is not None)
        feeder.fix(0.0, 0.0)
        tab = browser.tab(360, 640, mobile=True)
        tab.goto(f"{feeder.page.address}/?token={token.decode()}")
        tab.wait_for("map !== null && map.layers.pose !== null && zoomed", "a map")
        assert tab.run("document.documentElement.scrollWidth") <= 360, "nothing sticks out"
        tab.run("byId('draw').click(); map.centre = [0, 0]; map.scale = 4; map.draw()")
        west, north = tab.run("[...'xy'].map((k) => byId('map').getBoundingClientRect()[k])")
        wanted = [(-20.0, -15.0), (10.0, -15.0), (10.0, 12.0)]
        for corner, (east_m, north_m) in enumerate(wanted):
            assert tab.run("byId('send').hidden")
            x, y = tab.run(f"map.toScreen({east_m}, {north_m})")
            point = {"x": west + x, "y": north + y}
            tab.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[point])
            tab.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
            tab.wait_for(f"map.layers.area.length === {corner + 1}", "a corner")
        assert not tab.run("map.follows")
        tab.run("byId('send').click()")
        tab.wait_for("byId('search-note').textContent === 'accepted: searching in the area'", "an answer")
        assert tab.run("map.layers.area.length === 0 && map.onTap === null && byId('send').hidden")
        box = store.bounds
        origin = round((box[0] + box[2]) / 2), round((box[1] + box[3]) / 2)
        found = store.pack.georeference.map_from_lat_lon(commands[0].polygon) - origin
        assert np.abs(found - wanted).max() < 0.3, "a finger is put down on whole pixels"
        time.sleep(1.1)
        tab.run("byId('everywhere').click()")
        tab.wait_for("byId('search-note').textContent.includes('draw it anew')", "why not")
        assert HOSTILE in tab.text("#search-note") and tab.run("document.title") == "OrthoLoC", "text stays text"
        assert commands[1].polygon is None
        assert tab.console == []
    finally:
        feeder.page.close()


def test_without_commands_there_is_no_button_for_them(browser: Chromium, flying: Feeder) -> None:
    flying.fix(0.0, 0.0)
    tab = browser.tab(360, 640, mobile=True)
    tab.goto(f"{flying.page.address}/")
    tab.wait_for("map !== null", "a map")
    assert tab.run("byId('draw').hidden && byId('everywhere').hidden && byId('send').hidden")


def test_what_is_old_is_never_shown_as_fresh(browser: Chromium, flying: Feeder) -> None:
    """Fixes end, the link is lost, the camera falls silent, the frame path stands still, the daemon is gone."""
    tab = browser.tab(390, 844, mobile=True)
    tab.goto(f"{flying.page.address}/")
    flying.keep(20.0, tab, "document.getElementById('state-word').innerText === 'FIX'", "a fix")
    assert tab.run("document.getElementById('map-old').hidden")

    def until(script: str, what: str, feed) -> None:
        deadline = time.monotonic() + 20.0
        while not tab.run(script):
            assert time.monotonic() < deadline, f"{what}: the page says {tab.text('header')!r}"
            feed()
            time.sleep(0.1)

    def refused() -> None:
        flying.reject(40.0, 0.0)
        flying.health()

    until("document.getElementById('state-word').innerText.startsWith('NO FIX')", "no fix", refused)
    assert "the map fits here hardly better" in tab.text("#state")
    assert "last fix" in tab.text("#map-old"), "also on the map"
    assert tab.run("map.layers.old").endswith("old")
    assert tab.run("document.querySelectorAll('.figure.old').length") == 4, "the figures of the fix"

    def cut() -> None:
        flying.fix(40.0, 0.0)
        flying.health(connected=False, fusion="unknown", trouble="link endpoint serial:/dev/ttyAMA0 is not open")

    until("document.getElementById('state-word').innerText === 'LINK LOST'", "no link", cut)
    assert "LINK LOST" in tab.text("#badges") and "ttyAMA0 is not open" in tab.text("#figures")
    assert "fix, 0." in tab.text("#state"), "the camera still finds it"
    until("document.getElementById('state-word').innerText === 'NO FRAMES'", "no frames", flying.health)
    assert tab.run("map.layers.prior") is None, "a prediction of long ago"
    until("document.getElementById('state-word').innerText === 'PAUSED'", "paused", lambda: flying.health(paused=True))
    until("document.getElementById('state-word').innerText === 'STANDS STILL'", "standing still", lambda: None)
    flying.page.close()
    until("document.getElementById('state-word').innerText === 'NO CONTACT'", "no contact", lambda: None)
    assert tab.run("document.body.className") == "dead"
    assert "(old)" in tab.text("#badges")


def test_events_that_a_slow_line_held_back_are_old(browser: Chromium, flying: Feeder) -> None:
    """The age counts from the exposure, by the least delayed event, not from when it came."""
    tab = browser.tab(390, 844, mobile=True)
    tab.goto(f"{flying.page.address}/")
    flying.keep(20.0, tab, "document.getElementById('state-word').innerText === 'FIX'", "a fix")
    script = """(() => {
      const late = { session: known.session, now: daemonNow() - 8000, health: {...known.health},
                     marks: [{ ...lastFix(), n: lastFix().n + 1, t: daemonNow() - 8050 }] };
      late.health.now_ns = (daemonNow() - 8000) * 1e6;
      source.close();
      known.marks = [];
      hear(late);
      return byId("state-word").innerText;
    })()"""
    assert tab.run(script) in ("STANDS STILL", "NO FRAMES")


def test_the_page_comes_back_with_the_daemon(browser: Chromium, store: MapStore) -> None:
    listen = Listen("127.0.0.1", free_port(), False, None, frozenset())
    first = Feeder(store, listen)
    wait(lambda: first.page.address is not None)
    tab = browser.tab(390, 844, mobile=True)
    tab.goto(f"{first.page.address}/")
    first.keep(20.0, tab, "document.getElementById('state-word').innerText === 'FIX'", "a fix")
    session = tab.run("known.session")
    first.page.close()
    second = Feeder(store, listen)
    second.keep(30.0, tab, f"known.session !== {session!r} && byId('state-word').innerText === 'FIX'", "it came back")
    assert tab.run("known.track.length") < 200 and tab.run("known.marks[0].n") >= 0
    second.page.close()


def test_a_token_is_asked_for_and_then_remembered(browser: Chromium, store: MapStore) -> None:
    token = "0123456789abcdef"
    feeder = Feeder(store, Listen("127.0.0.1", free_port(), False, token.encode(), frozenset()))
    wait(lambda: feeder.page.address is not None)
    tab = browser.tab(390, 844, mobile=True)
    tab.goto(f"{feeder.page.address}/")
    assert "asks for its token" in tab.text("body")
    tab.run(f"document.querySelector('input').value = {token!r}")
    tab.run("document.querySelector('button').click()")
    tab.wait_for("location.search === '' && document.getElementById('state-word') !== null", "the page")
    feeder.keep(20.0, tab, "document.getElementById('state-word').innerText === 'FIX'", "a fix")
    assert tab.run("document.cookie") == "", "no script reads it"
    feeder.page.close()


def test_another_site_gets_nothing(browser: Chromium, flying: Feeder, store: MapStore) -> None:
    """A page of another origin can neither read the state nor show the map."""
    other = Feeder(store, Listen("127.0.0.1", free_port(), False, None, frozenset()))
    wait(lambda: other.page.address is not None)
    tab = browser.tab(390, 844)
    # Our own page has a policy that would forbid the attempt itself.
    tab.call("Page.setBypassCSP", enabled=True)
    tab.goto(f"{other.page.address}/")
    address = flying.page.address
    assert tab.run(f"fetch('{address}/state.json').then((r) => r.text(), () => 'refused')") == "refused"
    assert tab.run(f"fetch('{address}/state.json', {{mode: 'no-cors'}}).then((r) => r.text(), () => '')") == ""
    image = f"""new Promise((settled) => {{
      const shown = new Image();
      shown.onload = () => settled("shown");
      shown.onerror = () => settled("refused");
      shown.src = "{address}/tiles/0/0/0.jpg";
    }})"""
    assert tab.run(image) == "refused"
    other.page.close()


# -- the report ----------------------------------------------------------------------------------------


def test_a_report_is_one_file_that_steps_through_the_flight(browser: Chromium, store: MapStore, tmp_path: Path) -> None:
    west, south, east, north = store.bounds
    middle = np.array([(west + east) / 2, (south + north) / 2, 0.0])
    record = FlightRecord.over(store, CAMERA, NADIR)
    image = np.full((CAMERA.height, CAMERA.width, 3), 90, np.uint8)
    for k in range(6):
        low = a_fix(down(90.0))
        pose = Rigid3(low.map_from_camera.rotation, middle + np.array([20.0 * k, 5.0, 100.0]))
        shift = np.array([*(pose.translation - low.map_from_camera.translation)[:2], 0.0])
        fix = Fix(**{**_fields(low), "map_from_camera": pose, "points_map": low.points_map + shift})
        outcome: Outcome = Rejected(0, Reason.AMBIGUOUS, HOSTILE, 0.7, 0.6) if k == 3 else fix
        error = None if k == 3 else (0.25 + k, 0.5)
        record.add(
            f"frame_{k}", outcome, prior=PosePrior(pose, np.eye(6)), truth=pose, error=error,
            image=image if k != 2 else None,
        )  # fmt: skip
    page = record.page(store, f"a flight {HOSTILE}", ["a note"], "recall 100 %")
    assert page is not None
    path = tmp_path / "report.html"
    path.write_text(page, encoding="utf-8")
    tab = browser.tab(390, 844, mobile=True)
    tab.goto(path.as_uri())
    assert "fix, 1 σ 0.50 m across" in tab.text("#what") and "off the truth by 0.25 m" in tab.text("#what")
    assert tab.text("#name") == "1 of 6: frame_0" and "recall 100 %" in tab.text("pre")
    assert HOSTILE in tab.text("h1")
    for _ in range(3):
        tab.run("node('after').click()")
    assert "no fix: ambiguous" in tab.text("#what") and "measured 0.7, limit 0.6" in tab.text("#what")
    assert HOSTILE in tab.text("#what") and tab.run("document.title") == f"a flight {HOSTILE}"
    assert tab.run("map.layers.pose === null && map.layers.prior !== null")
    assert tab.run("map.layers.track.map((place) => place[2])") == [1, 1, 1, 0, 1, 1]
    tab.run("choose(2)")
    assert not tab.run("node('no-picture').hidden") and tab.run("node('frame').hidden")
    tab.wait_for("map.scene.picture.image.complete && map.scene.picture.image.naturalWidth > 100", "the orthophoto")
    assert tab.run("document.documentElement.scrollWidth") <= 390
    assert tab.console == []


def test_a_flight_beside_the_map_has_no_report(store: MapStore) -> None:
    record = FlightRecord.over(store, CAMERA)
    assert record.page(store, "nothing", [], "") is None
    record.add("far", a_fix(down(0.0)), prior=None, truth=None, error=None, image=None)
    assert record.page(store, "far away", [], "") is None
