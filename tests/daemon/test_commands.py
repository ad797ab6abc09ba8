"""Commands to the real daemon, over a real zenoh session: what they do to the flight, and that a replay knows of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from adapters.fake_autopilot import UdpWire
from adapters.hovering import PLACE, TRUTH, HoveringAutopilot, config, running, wait_for
from mcap.reader import make_reader
from replay import rendered
from test_bus import asked, free_port, listening, reply_of

from ortholoc_edge.adapters.bus import BusOptions
from ortholoc_edge.adapters.flight_log import LogOptions
from ortholoc_edge.adapters.messages import CommandReply
from ortholoc_edge.bench.flight_log import read_frames
from ortholoc_edge.cli import main
from ortholoc_edge.config import Config, without_secrets
from ortholoc_edge.daemon import Daemon
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.record import FrameRecord
from ortholoc_edge.pipeline.tracker import GivenPosition, StartAnew
from ortholoc_edge.reload import plan_reload

# North of where it is, which the gate can't take for a wrong height.
ASTRAY_M = 60.0


# Of a degree: 110 m, and less eastward.
MILLI = 0.001


def ring(*corners: tuple[float, float]) -> list[list[float]]:
    """Around where it is, corners north and east of it in thousandths of a degree."""
    return [[PLACE.lat_deg + MILLI * north, PLACE.lon_deg + MILLI * east] for north, east in corners]


def prior(**changes: Any) -> dict[str, Any]:
    here = {
        "lat_deg": PLACE.lat_deg, "lon_deg": PLACE.lon_deg, "height_amsl_m": PLACE.height_amsl_m,
        "sigma_horizontal_m": 5.0, "sigma_vertical_m": 5.0,
    }  # fmt: skip
    return {**here, **changes}


@dataclass
class Flown:
    """A flight with commands."""

    folder: Path
    outcomes: list[Outcome]
    replies: dict[str, CommandReply]
    states: dict[str, dict[str, Any]]
    texts: list[str]
    stats: dict[str, Any]
    config: dict[str, Any]
    searched: list[FloatArray | None]


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """Fixes; sent astray; called back; paused and resumed; a stricter gate and back; a snapshot taken."""
    folder = tmp_path_factory.mktemp("commanded")
    photo = rendered.write_picture(folder / "photos" / "photo_000.jpg", rendered.picture(TRUTH))
    for number in range(1, 400):
        photo.with_name(f"photo_{number:03d}.jpg").hardlink_to(photo)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    autopilot = HoveringAutopilot(UdpWire())
    outcomes: list[Outcome] = []
    daemon = Daemon(
        config(
            f"folder:{photo.parent}",
            f"udpout:127.0.0.1:{autopilot.wire.port}",
            bus=BusOptions(enabled=True, vehicle="hawk", listen=(endpoint,), commands=True, image_rate_hz=10.0),
            log=LogOptions(folder=str(folder / "log"), frames="all"),
        ),
        on_outcome=lambda _, outcome: outcomes.append(outcome),
    )
    searched: list[FloatArray | None] = []
    daemon._commander._search_in = lambda corners_map, now_ns: searched.append(corners_map)
    session = listening(endpoint)
    replies: dict[str, CommandReply] = {}
    states: dict[str, dict[str, Any]] = {}

    def command(name: str, label: str = "", **fields: Any) -> None:
        found = asked(session, f"ortholoc/hawk/command/{name}", json.dumps(fields).encode())
        replies[label or name] = reply_of(found)[1]

    def latest(key: str) -> Any:
        found = asked(session, f"ortholoc/hawk/{key}")
        return json.loads(found[0][3]) if found else None

    def ended_with(kind: Callable[[Outcome], bool], count: int, what: str) -> None:
        start = len(outcomes)
        wait_for(lambda: sum(kind(o) for o in outcomes[start:]) >= count, what)

    def is_fix(outcome: Outcome) -> bool:
        return isinstance(outcome, Fix)

    try:
        with running(daemon):
            ended_with(is_fix, 3, "three fixes")
            command("set_prior", "astray", **prior(lat_deg=PLACE.lat_deg + ASTRAY_M / 111_200.0))
            ended_with(lambda o: isinstance(o, Rejected), 2, "two rejections")
            command("set_prior", "outside", **prior(lat_deg=PLACE.lat_deg + 1.0))
            command("set_prior", "buried", **prior(height_amsl_m=-400.0))
            command("set_prior", "wide", **prior(sigma_horizontal_m=400.0))
            command("search", "search here", polygon=ring((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)))
            command("search", "search everywhere")
            command("search", "bow-tie", polygon=ring((-1, -1), (1, 1), (1, -1), (-1, 1)))
            command("search", "line", polygon=ring((0, 0), (1e-6, 0), (1e-6, 1e-6)))
            command("search", "point", polygon=ring((0, 0), (0, 0), (0, 0)))
            command("search", "elsewhere", polygon=ring((500, 0), (501, 0), (501, 1)))
            command("search", "swapped", polygon=[corner[::-1] for corner in ring((-1, -1), (1, -1), (1, 1))])
            command("search", "pole", polygon=[[90, 0], [90, 120], [90, -120]])
            daemon._commander._search_in = None
            command("search", "switched off")
            command("relocalize")
            ended_with(is_fix, 3, "fixes again")
            command("pause")
            states["paused"] = latest("state")
            ended_with(lambda o: getattr(o, "reason", None) is Reason.PAUSED, 2, "two frames left alone")
            command("pause", "pause again")
            command("resume")
            ended_with(is_fix, 2, "fixes after the pause")
            # A gate that nothing passes, for a while.
            flying = daemon._config
            gate = msgspec.structs.replace(flying.localizer.gate, min_contrast=1e6, min_sure_contrast=1e6)
            strict = msgspec.structs.replace(
                flying, localizer=msgspec.structs.replace(flying.localizer, gate=gate)
            )
            daemon.take_over(plan_reload(flying, strict))
            ended_with(lambda o: isinstance(o, Rejected), 2, "two rejections by the strict gate")
            daemon.take_over(plan_reload(strict, flying))
            ended_with(is_fix, 2, "fixes by the old gate")
            command("snapshot")
            states["last"] = latest("state")
            fix = wait_for(lambda: latest("fix"), "the latest fix")
            assert fix["stamp_ns"] in [o.stamp_ns for o in outcomes if is_fix(o)]
            assert wait_for(lambda: latest("health"), "health")["fixes"] > 0
            assert asked(session, "ortholoc/hawk/image")[0][2] == "image/jpeg"
            stats, seen_config = latest("stats")["statistics"], latest("config")["config"]
            texts = [str(m.text) for m in autopilot.messages("STATUSTEXT")]
    finally:
        session.close()
        autopilot.close()
    return Flown(folder / "log", outcomes, replies, states, texts, stats, seen_config, searched)


@pytest.fixture(scope="module")
def records(flown: Flown) -> list[FrameRecord]:
    return [one.record for path in sorted(flown.folder.glob("*.mcap")) for one in read_frames(path)]


def test_commands_are_answered(flown: Flown) -> None:
    accepted = {name for name, reply in flown.replies.items() if reply.accepted}
    assert accepted == {"astray", "search here", "search everywhere", "relocalize", "pause", "resume", "snapshot"}
    for name, words in {
        "outside": "m outside of the pack",
        "buried": "below the ground there",
        "wide": "400, up to 150 m is searched",
        "bow-tie": "cross or touch",
        "line": "no area",
        "point": "0 different corners",
        "elsewhere": "outside of the pack",
        "swapped": "km beyond the pack",
        "pole": "beyond the pack",
        "switched off": "does not search the map",
        "pause again": "paused already",
    }.items():
        assert words in flown.replies[name].reason
        assert flown.replies[name].remedy
    assert {text for text in flown.texts if "by command" in text} == {
        f"OrthoLoC: {name} by command" for name in ("set_prior", "search", "relocalize", "pause", "resume", "snapshot")
    }
    assert flown.states["paused"]["paused"] is True and flown.states["last"]["paused"] is False
    assert flown.states["last"]["status"] == "track"
    assert flown.stats["commands"] == 18 and flown.stats["commands_refused"] == 11


def test_a_given_position_is_where_the_next_frame_is_searched(records: list[FrameRecord]) -> None:
    """GNSS that contradicts it, surer of itself, does not take its place; until it is called back."""
    (number,) = (i for i, record in enumerate(records) if [type(order) for order in record.orders] == [GivenPosition])
    predicted = np.array(records[number].prior_map_from_camera)[:, 3]
    assert predicted[1] - TRUTH.translation[1] == pytest.approx(ASTRAY_M, abs=2.0)
    sigma = np.sqrt(np.diag(records[number].prior_covariance))
    assert 5.0 <= sigma[0] < 5.0 + 15.0, "the operator's, and what it may have flown since"
    assert not records[number].outcome["fix"]
    (back,) = (i for i, record in enumerate(records) if [type(order) for order in record.orders] == [StartAnew])
    assert records[back].outcome["fix"]
    assert np.linalg.norm(np.subtract(records[back].outcome["position_map_m"], TRUTH.translation)) < 2.0
    # The autopilot must hear of it as a new start.
    assert records[back + 1].reset_counter == (records[number].reset_counter + 1) % 256


def test_a_polygon_is_searched_where_it_lies_on_the_map(flown: Flown) -> None:
    here, everywhere = flown.searched
    assert everywhere is None
    assert here is not None and here.shape == (4, 2)
    assert np.linalg.norm(here.mean(axis=0) - TRUTH.translation[:2]) < 1.0
    corner = here[np.argmax(here.sum(axis=1))] - TRUTH.translation[:2]
    assert corner[1] == pytest.approx(111.2, rel=0.05), "a thousandth of a degree to the north"
    assert corner[0] == pytest.approx(111.2 * np.cos(np.radians(PLACE.lat_deg)), rel=0.05)


def test_a_replay_takes_the_commands_in_too(flown: Flown, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(flown.folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["same"] == found["repeated"] == found["steps"] > 8
    assert (found["alone"], found["left_out"]) == (0, 0)


@pytest.mark.parametrize("forgotten", [{"orders": ()}, {"tuning": None}])
def test_a_replay_without_them_would_lie(
    flown: Flown,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    forgotten: dict[str, Any],
) -> None:
    """That is what the test before is worth."""
    whole = FrameRecord.circumstances
    monkeypatch.setattr(
        FrameRecord, "circumstances", lambda record: whole(msgspec.structs.replace(record, **forgotten))
    )
    assert main(["replay", str(flown.folder), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["differ"]


def test_commands_are_in_the_log_for_people(flown: Flown) -> None:
    found = []
    for path in sorted(flown.folder.glob("*.mcap")):
        with path.open("rb") as file:
            found += [json.loads(m.data) for _, _, m in make_reader(file).iter_messages(topics=["/ortholoc/command"])]
    assert [(one["reply"]["command"], one["reply"]["accepted"]) for one in found] == [
        ("set_prior", True), ("set_prior", False), ("set_prior", False), ("set_prior", False), ("search", True),
        ("search", True), *[("search", False)] * 7, ("relocalize", True),
        ("pause", True), ("pause", False), ("resume", True), ("snapshot", True),
    ]  # fmt: skip


def test_a_paused_daemon_sends_nothing(flown: Flown, records: list[FrameRecord]) -> None:
    left_alone = [o.stamp_ns for o in flown.outcomes if getattr(o, "reason", None) is Reason.PAUSED]
    assert not {record.stamp_ns for record in records} & set(left_alone)
    assert [record.number for record in records] == list(range(len(records))), "and a replay has no gap there"


def test_a_snapshot_shows_the_frame_and_what_it_came_to(flown: Flown) -> None:
    assert flown.replies["snapshot"].path is not None
    picture = Path(flown.replies["snapshot"].path)
    assert picture.parent == flown.folder / "snapshots"
    assert sorted(p.suffix for p in picture.parent.iterdir()) == [".json", ".png"]
    content = json.loads(picture.with_suffix(".json").read_text(encoding="utf-8"))
    image = cv2.cvtColor(cv2.imread(str(picture)), cv2.COLOR_BGR2RGB)
    assert image.shape == (rendered.CAMERA.height, rendered.CAMERA.width, 3)
    assert np.abs(image.astype(int) - rendered.picture(TRUTH)).mean() < 10, "the colours in their order"
    assert content["outcome"]["fix"] is True
    assert content["step"]["name"] == content["name"]
    assert content["statistics"]["fixes"] > 0


def test_the_configuration_is_told_without_its_secrets(flown: Flown) -> None:
    assert flown.config["bus"]["vehicle"] == "hawk"
    base = config("rtsp://pilot:geheim@10.0.0.2:554/a", "udpout:127.0.0.1:9")
    secret = msgspec.structs.replace(
        base, link=msgspec.structs.replace(base.link, signing_key="/etc/keys/one", signing_state="/var/keys/state")
    )
    told = without_secrets(secret)
    assert told["camera"]["source"] == "rtsp://(left out)@10.0.0.2:554/a"
    assert told["link"]["signing_key"] == "(left out)"
    assert msgspec.convert(told, Config).map == base.map, "and can still be read"
    pipeline = 'gstreamer:rtspsrc location=rtsp://a:b@c/d user-id=pilot user-pw="ge heim" ! appsink'
    told = without_secrets(config(pipeline, "udpout:127.0.0.1:9"))
    for word in ("pilot", "heim", "a:b"):
        assert word not in told["camera"]["source"]
    assert told["camera"]["source"].endswith("! appsink")
    text = json.dumps(without_secrets(secret))
    assert "geheim" not in text and "keys" not in text
