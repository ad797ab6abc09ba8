"""What goes wrong on an aircraft and around it: fault, expected reason or error, and what stays unaffected.

No fix is better than a wrong one: where a fault may leave a right pose within reach, it is only a wrong one that fails.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from replay import rendered

from ortholoc_edge.adapters.camera import CameraOptions
from ortholoc_edge.adapters.mavlink import LinkOptions
from ortholoc_edge.bench import sequence
from ortholoc_edge.cli import EXIT_FAILED, main
from ortholoc_edge.config import Config, Intrinsics, MapOptions, MatcherOptions
from ortholoc_edge.daemon import Daemon
from ortholoc_edge.errors import MapError, ModelError
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.types import Matcher
from ortholoc_edge.matching.xfeat import XFeatMatcher
from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.navigator import Navigator
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.pipeline.tracker import Tracker, TrackerOptions
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

PLACES = [
    rendered.pose(),
    rendered.pose(220.0, 180.0, roll_deg=-5.0, pitch_deg=8.0, yaw_deg=200.0),
    rendered.pose(400.0, 330.0, pitch_deg=25.0, yaw_deg=-70.0),
]
FALSE_M, FALSE_DEG = 10.0, 5.0


@pytest.fixture(scope="module", params=["sift", "xfeat"])
def matcher(request: pytest.FixtureRequest) -> Matcher:
    if request.param == "sift":
        return rendered.sift()
    model = request.getfixturevalue("xfeat_model")
    return XFeatMatcher(model.graph, model.sha256)


@pytest.fixture
def localizer_of() -> Iterator[Callable[..., Localizer]]:
    made: list[Localizer] = []

    def make(store: MapStore | None = None, matcher: Matcher | None = None, camera=rendered.CAMERA) -> Localizer:
        made.append(Localizer(camera, store or rendered.store(), matcher or rendered.sift(), LocalizerOptions()))
        return made[-1]

    yield make
    for localizer in made:
        localizer.close()


def is_right(outcome: Outcome, truth: Rigid3) -> bool:
    return isinstance(outcome, Fix) and rendered.errors(outcome.map_from_camera, truth)[0] < 2.0


def is_wrong(outcome: Outcome, truth: Rigid3) -> bool:
    if not isinstance(outcome, Fix):
        return False
    off_m, off_deg = rendered.errors(outcome.map_from_camera, truth)
    return off_m > FALSE_M or off_deg > FALSE_DEG


# -- the picture -------------------------------------------------------------

PICTURES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "black": np.zeros_like,
    "white": lambda image: np.full_like(image, 255),
    "noise": lambda image: np.random.default_rng(1).integers(0, 256, image.shape, dtype=np.uint8),
    "mirrored": lambda image: np.ascontiguousarray(image[:, ::-1]),
    "upside-down mirrored": lambda image: np.ascontiguousarray(image[::-1]),
    "stripes": lambda image: np.broadcast_to(
        (np.arange(image.shape[1]) % 16 * 16).astype(np.uint8)[None, :, None], image.shape
    ).copy(),
}


@pytest.mark.parametrize("fault", PICTURES)
def test_picture_that_shows_nothing_of_the_map(
    matcher: Matcher, fault: str, localizer_of: Callable[..., Localizer]
) -> None:
    truth = PLACES[1]
    localizer = localizer_of(matcher=matcher)
    image = PICTURES[fault](rendered.picture(truth))
    outcome = localizer.localize(Frame(0, image, fault), rendered.prior(truth))
    assert isinstance(outcome, Rejected), "a fix"
    assert outcome.reason in (
        Reason.FEW_MATCHES, Reason.FEW_INLIERS, Reason.LOW_INLIER_RATIO, Reason.DEGENERATE_GEOMETRY,
    )  # fmt: skip


def test_the_next_frame_is_unaffected(localizer_of: Callable[..., Localizer]) -> None:
    truth = PLACES[1]
    localizer = localizer_of()
    before = localizer.localize(rendered.frame(truth), rendered.prior(truth))
    for image in (np.zeros((360, 480, 3), np.uint8), np.zeros((3, 3), np.uint8)):
        assert isinstance(localizer.localize(Frame(0, image, "bad"), rendered.prior(truth)), Rejected)
    after = localizer.localize(rendered.frame(truth), rendered.prior(truth))
    assert is_right(before, truth)
    assert isinstance(before, Fix)
    assert isinstance(after, Fix)
    assert np.array_equal(before.map_from_camera.translation, after.map_from_camera.translation)


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    return rendered.write_flight(tmp_path / "flight", PLACES)


@pytest.fixture
def intrinsics(tmp_path: Path) -> Path:
    camera = rendered.CAMERA
    path = tmp_path / "K.json"
    path.write_text(json.dumps({"intrinsics": camera.matrix.tolist()}), encoding="utf-8")
    return path


def truncate(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def test_truncated_photo(flight: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One photo is lost, the others are not. (The daemon's turn: tests/daemon.)"""
    photo = flight / "photos" / "frame_01.jpg"
    truncate(photo)
    pack = rendered.store().pack.path
    sift = ["--matcher", "sift"]
    assert main(["localize", str(photo), "--pack", str(pack), "--intrinsics", str(intrinsics), "--json", *sift]) == 1
    told = json.loads(capsys.readouterr().out)
    assert (told["fix"], told["reason"]) == (False, "bad_frame")
    assert str(photo) in told["detail"]
    assert "truncated" in told["detail"]

    assert main(["replay", str(flight), "--pack", str(pack), "--prior", "gps", "--json", *sift]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["rejected"] == {"bad_frame": 1}
    assert summary["fixes"] == 2
    assert summary["te_m"]["max"] < 2.0


# -- the place ---------------------------------------------------------------


def test_photo_of_another_place(matcher: Matcher, localizer_of: Callable[..., Localizer]) -> None:
    """Photos of Caliterra where the prior says Seneca: at the camera poses of Seneca's own photos."""
    store = rendered.real_store("seneca")
    there = sequence.read_flight(rendered.REAL / "seneca")
    foreign = sequence.read_flight(rendered.REAL / "caliterra")
    localizers = {record.camera: localizer_of(store, matcher, record.camera) for record in foreign}
    outcomes = []
    for index, record in enumerate(foreign[::9]):
        for place in there[index::14]:
            frame = Frame(0, record.image(), f"{record.name} at {place.name}")
            prior = rendered.prior(place.map_from_camera, sigma_m=(10.0, 10.0))
            outcomes.append(localizers[record.camera].localize(frame, prior))
    assert len(outcomes) >= 3
    assert [o for o in outcomes if isinstance(o, Fix)] == []
    # It was the pictures that did not fit, not the places.
    assert not {o.reason for o in outcomes} & {Reason.OUTSIDE_MAP, Reason.MAP_NODATA, Reason.PRIOR_TOO_WIDE}


def test_rendered_frame_at_another_place(matcher: Matcher, localizer_of: Callable[..., Localizer]) -> None:
    localizer = localizer_of(matcher=matcher)
    for seen, believed in ((0, 1), (1, 2), (2, 0)):
        outcome = localizer.localize(rendered.frame(PLACES[seen]), rendered.prior(PLACES[believed]))
        assert isinstance(outcome, Rejected), (seen, believed)


# -- the prior ---------------------------------------------------------------


@pytest.mark.parametrize("truth", PLACES, ids=["nadir", "tilted", "oblique"])
def test_datum_error_of_fifty_metres(truth: Rigid3, matcher: Matcher, localizer_of: Callable[..., Localizer]) -> None:
    """Ellipsoid taken for sea level: the autopilot's height is off by the geoid's, far beyond its sigma."""
    localizer = localizer_of(matcher=matcher)
    for off_m in (50.0, -50.0):
        outcome = localizer.localize(rendered.frame(truth), rendered.prior(truth, (0.0, 0.0, off_m)))
        assert not is_wrong(outcome, truth), off_m


@pytest.mark.parametrize("truth", PLACES, ids=["nadir", "tilted", "oblique"])
def test_heading_half_a_turn_wrong(truth: Rigid3, matcher: Matcher, localizer_of: Callable[..., Localizer]) -> None:
    outcome = localizer_of(matcher=matcher).localize(
        rendered.frame(truth), rendered.prior(truth, error_deg=(0.5, 0.5, 180.0))
    )
    assert isinstance(outcome, Rejected)


@pytest.mark.parametrize("entry", [(0, 0), (2, 1)])
def test_nan_attitude(entry: tuple[int, int], localizer_of: Callable[..., Localizer]) -> None:
    truth = PLACES[0]
    body = Rigid3(frames.BODY_FROM_NADIR_CAMERA, np.zeros(3))
    navigator = Navigator(localizer_of(), Tracker(rendered.georeference(), body, TrackerOptions()))

    def step(ned_from_body: np.ndarray | None, stamp_ns: int) -> Outcome:
        sigma = (0.02, 0.02, 0.05)
        state = VehicleState(stamp_ns, ned_from_body, sigma, None, 0, truth.translation + 1.0, (3.0, 3.0))
        return navigator.step(Frame(stamp_ns, rendered.picture(truth), "one"), state)

    good = rendered.attitude(yaw_deg=30.0)
    bad = good.copy()
    bad[entry] = np.nan
    for attitude in (bad, None):
        outcome = step(attitude, 1)
        assert isinstance(outcome, Rejected)
        assert outcome.reason is Reason.BAD_ATTITUDE
        assert navigator.prior is None
    assert is_right(step(good, 2), truth)


def test_nan_attitude_on_the_command_line(flight: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["localize", flight / "photos" / "frame_00.jpg", "--pack", rendered.store().pack.path, "--intrinsics",
                 intrinsics, "--position", "647100,5407450,520", "--attitude", "nan,0,0", "--json"]  # fmt: skip
    assert main([*map(str, arguments), "--matcher", "sift"]) == EXIT_FAILED
    assert json.loads(capsys.readouterr().out)["reason"] == "bad_attitude"


# -- the pack ----------------------------------------------------------------


def damage(path: Path) -> None:
    """Flip 200 bytes in the middle of a tile."""
    data = bytearray(path.read_bytes())
    for at in range(len(data) // 2, len(data) // 2 + 200):
        data[at] ^= 0xFF
    path.write_bytes(data)


def tile_under(pack: Pack, kind: str, at: Rigid3) -> str:
    layer = getattr(pack.manifest, kind)
    for tile in layer.tiles:
        west, south, east, north = layer.lattice.grid(tile.box).bounds
        if west <= at.translation[0] < east and south <= at.translation[1] < north:
            return str(tile.file)
    raise AssertionError(f"no tile of the {kind} under {at.translation}")


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    return shutil.copytree(rendered.store().pack.path, tmp_path / "pack")


@pytest.fixture
def damaged(copied: Path) -> Path:
    """The demo pack with a damaged block in one tile of its orthophoto."""
    damage(copied / tile_under(rendered.store().pack, "dop", PLACES[0]))
    return copied


def holes(store: MapStore, at: Rigid3, reach_m: float) -> float:
    """Share of the orthophoto around a place that only the sound pack has, at the scales of a flight."""
    x, y = at.translation[:2]
    lost = []
    for gsd_m in (0.25, 0.5):
        there, here = (
            one.read((x - reach_m, y - reach_m, x + reach_m, y + reach_m), gsd_m) for one in (rendered.store(), store)
        )
        assert there is not None
        assert here is not None
        lost.append(float((there.dop_valid & ~here.dop_valid).mean()))
    return max(lost)


def test_corrupt_tile_is_flown_around(damaged: Path, localizer_of: Callable[..., Localizer]) -> None:
    """Over the hole no wrong fix, beside it the right ones."""
    name = tile_under(rendered.store().pack, "dop", PLACES[0])
    assert any(name in problem for problem in Pack.open(damaged).verify())
    with MapStore(Pack.open(damaged)) as store:
        assert store.damaged == [name]
        places = [rendered.pose(float(e), float(n)) for e in range(60, 580, 40) for n in range(60, 460, 40)]
        in_tile = [at for at in places if tile_under(store.pack, "dop", at) == name]
        bad = max(in_tile, key=lambda at: holes(store, at, 40.0))
        good = [at for at in places[::4] if holes(store, at, 100.0) == 0.0]
        assert holes(store, bad, 40.0) > 0.5
        assert good
        localizer = localizer_of(store)
        assert not is_wrong(localizer.localize(rendered.frame(bad), rendered.prior(bad)), bad)
        elsewhere = good[len(good) // 2]
        assert is_right(localizer.localize(rendered.frame(elsewhere), rendered.prior(elsewhere)), elsewhere)


@pytest.mark.parametrize("kind", ["dop", "dsm"])
def test_missing_tile_gives_no_fix_over_it(copied: Path, kind: str, localizer_of: Callable[..., Localizer]) -> None:
    pack = rendered.store().pack
    (copied / tile_under(pack, kind, PLACES[1])).unlink()
    far = rendered.pose(500.0, 250.0)
    assert tile_under(pack, kind, far) != tile_under(pack, kind, PLACES[1])
    with MapStore(Pack.open(copied)) as store:
        localizer = localizer_of(store)
        over = localizer.localize(rendered.frame(PLACES[1]), rendered.prior(PLACES[1]))
        assert isinstance(over, Rejected)
        assert over.reason in (Reason.MAP_NODATA, Reason.OUTSIDE_MAP)
        assert is_right(localizer.localize(rendered.frame(far), rendered.prior(far)), far)


def write_rasters(folder: Path, crs: str | None, hole_m: tuple[float, float, float, float] | None = None):
    """The middle of the demo world as plain rasters; ``hole_m``: DSM without data (west, south, east, north)."""
    folder.mkdir(parents=True, exist_ok=True)
    window = rendered.map_window(130.0, 0.5)
    paths = folder / "dop_source.tif", folder / "dsm_source.tif"
    if hole_m is not None:
        grid = window.dsm_grid
        u, v = np.meshgrid(np.arange(grid.width), np.arange(grid.height))
        at = grid.map_from_px(np.stack([u, v], axis=-1)) - rendered.pose().translation[:2]
        west, south, east, north = hole_m
        inside = (at[..., 0] > west) & (at[..., 0] < east) & (at[..., 1] > south) & (at[..., 1] < north)
        window = dataclasses.replace(window, dsm=np.where(inside, np.float32(np.nan), window.dsm))
    rendered.write_map(window, *paths, crs)
    return paths


def test_missing_surface_under_the_view(tmp_path: Path, localizer_of: Callable[..., Localizer]) -> None:
    truth = rendered.pose()
    # Wider than the view by more than the search: around it there are heights, below it none.
    sources = write_rasters(tmp_path / "holed", "EPSG:32632", (-105.0, -105.0, 105.0, 105.0))
    with MapStore(build_pack(*sources, tmp_path / "pack", PackOptions(vertical="unknown"))) as store:
        outcome = localizer_of(store).localize(rendered.frame(truth), rendered.prior(truth))
    assert isinstance(outcome, Rejected)
    assert outcome.reason in (Reason.MAP_NODATA, Reason.OUTSIDE_MAP)


def test_half_a_surface_is_enough_or_nothing(tmp_path: Path, localizer_of: Callable[..., Localizer]) -> None:
    """Half the view without heights: its matches are dropped, and what is left must not bend the pose."""
    truth = rendered.pose()
    sources = write_rasters(tmp_path / "holed", "EPSG:32632", (0.0, -200.0, 200.0, 200.0))
    with MapStore(build_pack(*sources, tmp_path / "pack", PackOptions(vertical="unknown"))) as store:
        outcome = localizer_of(store).localize(rendered.frame(truth), rendered.prior(truth))
    assert not is_wrong(outcome, truth)
    if isinstance(outcome, Fix):
        assert (outcome.points_map[:, 0] <= truth.translation[0] + 1.0).all()


def config(pack: Path, folder: Path) -> Config:
    camera = rendered.CAMERA
    return Config(
        camera=CameraOptions(source=f"folder:{folder}"),
        intrinsics=Intrinsics(
            width_px=camera.width, height_px=camera.height, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy
        ),
        map=MapOptions(pack=str(pack)),
        link=LinkOptions(endpoint="udp:127.0.0.1:0"),
        matcher=MatcherOptions(name="sift"),
    )


@pytest.mark.parametrize(
    ("crs", "options", "remedy"),
    [
        (None, PackOptions(vertical="unknown"), "projected"),
        ("EPSG:32632", PackOptions(vertical="unknown"), "--vertical"),
    ],
    ids=["no CRS", "no datum"],
)
def test_pack_that_cannot_be_flown(crs: str | None, options: PackOptions, remedy: str, tmp_path: Path) -> None:
    sources = write_rasters(tmp_path / "sources", crs)
    pack = build_pack(*sources, tmp_path / "pack", options)
    rendered.write_picture(tmp_path / "frames" / "a.jpg", rendered.picture(PLACES[0]))
    with pytest.raises(MapError, match=remedy) as refused:
        Daemon(config(pack.path, tmp_path / "frames"))
    assert str(pack.path) in str(refused.value)


def test_corrupt_pack_is_told_to_the_pilot_or_keeps_the_daemon_on_the_ground(
    damaged: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rendered.write_picture(tmp_path / "frames" / "a.jpg", rendered.picture(PLACES[0]))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        link = LinkOptions(endpoint=f"udp:127.0.0.1:{one.getsockname()[1]}")
    asked = msgspec.structs.replace(config(damaged, tmp_path / "frames"), link=link)
    daemon = Daemon(asked)
    assert daemon.statistics()["map_files_damaged"] == 1
    texts: list[str] = []
    monkeypatch.setattr(daemon.link, "connected", lambda: True)
    monkeypatch.setattr(daemon.link, "send_status_text", lambda severity, text: texts.append(text))
    daemon.run(threading.Event())
    assert texts == ["OrthoLoC: 1 map files damaged"]
    assert "holes in the map: 1 files are damaged or missing, the last dop/" in caplog.text
    with pytest.raises(MapError, match=r"1 damaged or missing files, the first dop/.*require_intact"):
        Daemon(msgspec.structs.replace(asked, map=MapOptions(pack=str(damaged), require_intact=True)))


def test_pack_over_the_memory_budget_keeps_the_daemon_on_the_ground(tmp_path: Path) -> None:
    asked = config(rendered.store().pack.path, tmp_path)
    with pytest.raises(MapError, match=r"map\.memory_mb"):
        Daemon(msgspec.structs.replace(asked, map=MapOptions(pack=asked.map.pack, memory_mb=1)))


# -- the model ---------------------------------------------------------------


def test_model_of_another_hash(
    tmp_path: Path, flight: Path, intrinsics: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "xfeat.onnx"
    model.write_bytes(b"not what was tested")
    arguments = ["localize", flight / "photos" / "frame_00.jpg", "--pack", rendered.store().pack.path,
                 "--intrinsics", intrinsics, "--matcher", "xfeat", "--model", model,
                 "--model-sha256", "0" * 64]  # fmt: skip
    assert main([*map(str, arguments)]) == EXIT_FAILED
    told = capsys.readouterr()
    assert told.out == ""
    assert str(model) in told.err
    assert "Traceback" not in told.err
    assert "use the file that the hash was taken of" in told.err
    with pytest.raises(ModelError, match=r"xfeat\.onnx"):
        Daemon(
            Config(
                camera=CameraOptions(source=f"folder:{flight / 'photos'}"),
                intrinsics=Intrinsics(width_px=480, height_px=360, fx=405.0, fy=405.0, cx=239.5, cy=179.5),
                map=MapOptions(pack=str(rendered.store().pack.path)),
                link=LinkOptions(endpoint="udp:127.0.0.1:0"),
                matcher=MatcherOptions(name="xfeat", model=str(model), model_sha256="0" * 64),
            )
        )


def test_prior_sigmas_that_lie_do_not_make_a_wrong_fix(localizer_of: Callable[..., Localizer]) -> None:
    """A prior 25 m off that claims 1 m: refused, or right all the same."""
    truth = PLACES[0]
    off = rendered.prior(truth, (18.0, -17.0, 0.0), sigma_m=(1.0, 1.0))
    assert isinstance(off, PosePrior)
    assert not is_wrong(localizer_of().localize(rendered.frame(truth), off), truth)
    assert rotation.angle_between(off.map_from_camera.rotation, truth.rotation) < 0.1
