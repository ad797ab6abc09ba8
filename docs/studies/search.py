"""How often, and in what time, a frame is found in a whole map of which nothing is known but attitude and height
(search.md).

    python docs/studies/search.py area SOURCES --side-km 10          rasters of a country, for `tiles build`
    python docs/studies/search.py frames PACK OUT.npz --look 2019 --count 40 --agl 120 --seed 2
    python docs/studies/search.py find PACK OUT.npz --heading 10 --height barometer
    python docs/studies/search.py find PACK OUT.npz --hostile mirrored         where nothing may be found; or: absent
    python docs/studies/search.py others PACK OUT.npz                          SIFT with votes, and VLAD

PACK is of the simulation's endless country (`ortholoc_sim.country`). What is known of a frame is off by 0.7 deg of tilt
and 3 % of the height above ground (1-sigma), and by up to ``--heading`` degrees.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import rasterio
from msgspec import Struct

from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.matching.types import Structural
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.locate import locate
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.rectify import rectified
from ortholoc_edge.pipeline.search import Candidate, Former, Searcher, Sighting, fitting_level
from ortholoc_edge.tiles.coarse import CoarseField
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore
from ortholoc_sim.camera import Sensor
from ortholoc_sim.country import CENTRE, FLIGHT, FRAME, SURVEYS, Country
from ortholoc_sim.wide import WideRenderer

CAMERA = Camera.from_focal(640, 480, 540.0)
TILT_SIGMA_RAD, HEIGHT_SIGMA, FLOWN_TILT_SIGMA_RAD = math.radians(0.7), 0.03, math.radians(4.0)
# A candidate this near is right, and a fix this near.
NEAR_M, RIGHT_M = 12.0, 3.0
GONE_M = 240.0
SHEET_M, ALONG_M = 2000.0, 30.0
RANKS = (1, 5, 20)
# Candidates of an earlier frame.
KEPT = 60


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A frame with its true pose and the ground below it.

    ``flight``: which it is of; its frames follow each other.
    """

    image: ImageArray
    pose: Rigid3
    ground_m: float
    flight: int


def area(args: argparse.Namespace) -> None:
    """Orthophoto and surface model of a square of a country, as GeoTIFFs of 2 km."""
    country, look = Country(args.country), SURVEYS[2023]
    low = np.array(CENTRE) - args.side_km * 500.0
    for kind, gsd in (("dop", 0.4), ("dsm", 2.0)):
        (args.out / kind).mkdir(parents=True, exist_ok=True)
        side = round(SHEET_M / gsd)
        for j in range(round(args.side_km * 1000.0 / SHEET_M)):
            for i in range(round(args.side_km * 1000.0 / SHEET_M)):
                path = args.out / kind / f"{kind}_{i}_{j}.tif"
                if path.exists():
                    continue
                west, south = low + np.array([i, j]) * SHEET_M
                grid = RasterGrid(side, side, west, south + SHEET_M, gsd, -gsd)
                bands = (
                    np.moveaxis(country.rgb(grid, FRAME, look), 2, 0)
                    if kind == "dop"
                    else country.heights(grid, FRAME, look)[None]
                )
                part = path.with_suffix(".part")
                with rasterio.open(
                    part, "w", driver="GTiff", width=side, height=side, count=len(bands), dtype=bands.dtype, crs=FRAME,
                    transform=rasterio.Affine(gsd, 0.0, west, 0.0, -gsd, south + SHEET_M), compress="deflate", tiled=True,
                ) as file:  # fmt: skip
                    file.write(bands)
                part.rename(path)


def make(args: argparse.Namespace) -> None:
    """Frames at random places and headings of the pack's area, drawn as the simulation's camera sees them; of each
    place ``--each`` of them, 30 m apart in the direction of flight."""
    store = MapStore(Pack.open(args.pack))
    look = FLIGHT if args.look == "flight" else SURVEYS[int(args.look)]
    rng, country, sensor, made = np.random.default_rng(args.seed), Country(args.country), Sensor(), []
    west, south, east, north = store.bounds
    reach_m = 120.0 + ALONG_M * (args.each - 1)
    while len(made) < args.count * args.each:
        place = rng.uniform((west + reach_m, south + reach_m), (east - reach_m, north - reach_m))
        yaw = rng.uniform(0.0, 2.0 * math.pi)
        ahead = np.array([math.sin(yaw), math.cos(yaw)])
        below = country.ground(place + np.arange(args.each)[:, None] * ALONG_M * ahead)
        renderer = WideRenderer(
            country, store.pack.manifest.crs, look, sensor, ground_m=float(below[0]), grid_scale=1.0,
            texel_m=0.2,
        )  # fmt: skip
        for k in range(args.each):
            tilts = np.clip(rng.normal(0.0, FLOWN_TILT_SIGMA_RAD, 2), -0.2, 0.2)
            turn = frames.ENU_FROM_NED @ rotation.from_euler(*tilts, yaw) @ frames.BODY_FROM_NADIR_CAMERA
            pose = Rigid3(turn, np.append(place + k * ALONG_M * ahead, below[0] + args.agl))
            image = sensor.expose(renderer.clean(CAMERA, pose), CAMERA, len(made))
            made.append((image, turn, pose.translation, below[k]))
    images, turns, places, grounds = (np.array(part) for part in zip(*made, strict=True))
    np.savez_compressed(args.out, images=images, turns=turns, places=places, grounds=grounds, each=args.each)


def cases(path: Path) -> Iterator[Case]:
    with np.load(path) as data:
        parts = [data[key] for key in ("images", "turns", "places", "grounds")]
        each = int(data["each"])
    for number, (image, turn, place, ground) in enumerate(zip(*parts, strict=True)):
        yield Case(image, Rigid3(turn, place), float(ground), number // each)


def sightings(path: Path, heading_deg: float, barometer: bool) -> Iterator[tuple[Case, Sighting]]:
    """Each frame and what is known of it. Heading and height are off alike for all of a flight."""
    rng = np.random.default_rng(7)
    flight = -1
    for case in cases(path):
        if case.flight != flight:
            flight, off = case.flight, rng.uniform(-1.0, 1.0) * math.radians(heading_deg)
            wrong = float(rng.normal(0.0, HEIGHT_SIGMA))
        tilt = rotation.exp([*rng.normal(0.0, TILT_SIGMA_RAD, 2), 0.0])
        above_m = float(case.pose.translation[2]) - case.ground_m
        yield (
            case,
            Sighting(
                np.asarray(cv2.cvtColor(case.image, cv2.COLOR_RGB2GRAY), dtype=np.uint8),
                CAMERA,
                rotation.exp([0.0, 0.0, off]) @ tilt @ case.pose.rotation,
                math.radians(heading_deg),
                math.nan if barometer else (1.0 + wrong) * above_m,
                float(case.pose.translation[2]) + wrong * above_m if barometer else math.nan,
            ),
        )


class Found(Struct, kw_only=True):
    """What a frame came to, as a line of JSON.

    Attributes:
        rank: of the right place among the candidates, 0 the first; 999 where it is not among them.
        scores: of the first candidates.
        lead, chance: as of `Located`.
        support, reason: of the fix that is believed, or why there is none.
        passed: (score, support, error m) of each place that the localizer itself lets pass, `LocateOptions` aside.
        error_m: of the fix.
        cpu_s, wall_s: of search and localizer.
    """

    number: int
    frames: int
    hostile: str | None
    rank: int
    scores: list[float]
    lead: float
    chance: float = math.nan
    support: float | None
    reason: str | None
    passed: list[tuple[float, float, float]]
    error_m: float | None
    cpu_s: float
    wall_s: float


def find(args: argparse.Namespace) -> None:
    """Look for each frame, or each flight's last with the help of those before; go on where a run was ended."""
    store = MapStore(Pack.open(args.pack))
    level = fitting_level(store.dop_grids, CAMERA, args.agl)
    began = time.process_time()
    field = CoarseField.of(store, level)
    made_s = time.process_time() - began
    print(
        f"{field.known_km2:.1f} km2, {field.grid.gsd_m:g} m, {field.bytes / 1e6:.1f} MB, {made_s:.1f} s CPU", flush=True
    )
    localizer = Localizer(CAMERA, store, Structural(), LocalizerOptions())
    whole = Searcher(field, args.threads)
    done = len(args.out.read_text().splitlines()) if args.out.exists() else 0
    flights = itertools.groupby(
        sightings(args.frames, args.heading, args.height == "barometer"), lambda one: one[0].flight
    )
    with args.out.open("a") as out:
        for number, (_, members) in enumerate(flights):
            if number == args.count:
                break
            if number < done:
                continue
            flight = list(members)[: args.use]
            if args.hostile == "mirrored":
                flight = [mirrored(*one) for one in flight]
            searcher = whole
            if args.hostile == "absent":
                searcher = Searcher(without(field, [case.pose.translation[:2] for case, _ in flight]), args.threads)
            cpu, wall = time.process_time(), time.monotonic()
            former: list[tuple[FloatArray, list[Candidate]]] = []
            for case, known in flight:
                at = case.pose.translation[:2]
                # An autopilot's odometry, 3 % long.
                earlier = [Former(own, 1.03 * (at - there)) for there, own in former]
                if case is not flight[-1][0]:
                    former.append((at, searcher.search(known, KEPT)))
            located = locate(Frame(0, case.image, str(number)), known, searcher, localizer, former=earlier)
            cpu_s, wall_s = time.process_time() - cpu, time.monotonic() - wall
            place = case.pose.translation
            # What `LocateOptions` refuse, too: by other ones this can be judged afterwards.
            passed = [
                (one.score, outcome.quality, float(np.linalg.norm(outcome.map_from_camera.translation - place)))
                for one, outcome in zip(located.candidates, located.tried, strict=False)
                if isinstance(outcome, Fix)
            ]
            fix = located.outcome if isinstance(located.outcome, Fix) else None
            away = [math.hypot(one.easting_m - place[0], one.northing_m - place[1]) for one in located.candidates]
            found = Found(
                number=number,
                frames=len(flight),
                hostile=args.hostile,
                rank=next((rank for rank, m in enumerate(away) if m < NEAR_M), 999),
                scores=[one.score for one in located.candidates[:20]],
                lead=located.lead if math.isfinite(located.lead) else 999.0,
                chance=located.chance,
                support=None if fix is None else fix.quality,
                reason=None if fix is not None else str(located.outcome.reason),
                passed=passed,
                error_m=None if fix is None else float(np.linalg.norm(fix.map_from_camera.translation - place)),
                cpu_s=cpu_s,
                wall_s=wall_s,
            )
            out.write(msgspec.json.encode(found).decode() + "\n")
            out.flush()
            if searcher is not whole:
                searcher.close()
    summarise(args)


def without(field: CoarseField, places: list[FloatArray]) -> CoarseField:
    """The map without the surroundings of places."""
    reach = round(GONE_M / field.grid.gsd_m)
    quantised = field.quantised.copy()
    for column, row in np.round(field.grid.px_from_map(np.array(places))).astype(int).tolist():
        quantised[:, max(row - reach, 0) : row + reach, max(column - reach, 0) : column + reach] = 0
    return replace(field, quantised=quantised)


def mirrored(case: Case, known: Sighting) -> tuple[Case, Sighting]:
    """As the camera of another world sees it."""
    image, grey = (np.ascontiguousarray(picture[:, ::-1]) for picture in (case.image, known.grey))
    return replace(case, image=image), replace(known, grey=grey)


def summarise(args: argparse.Namespace) -> None:
    """A row of what a run has found."""
    found = [msgspec.json.decode(line, type=Found) for line in args.out.read_text().splitlines()]
    ranks, cpu_s, wall_s = (np.array([getattr(one, key) for one in found]) for key in ("rank", "cpu_s", "wall_s"))
    right = sum(one.error_m is not None and one.error_m < RIGHT_M for one in found)
    wrong = [one for one in found if one.error_m is not None and (one.hostile or not one.error_m < RIGHT_M)]
    told = ", ".join(f"R@{k} {100 * np.mean(ranks < k):.1f} %" for k in RANKS)
    print(
        f"{args.out.stem}: {len(found)} of {found[0].frames} frame(s): {told}; fixes right {right}, wrong {len(wrong)}; "
        f"CPU {np.median(cpu_s):.1f} s, p95 {np.quantile(cpu_s, 0.95):.1f}, worst {cpu_s.max():.1f}; wall "
        f"{np.median(wall_s):.1f} s, worst {wall_s.max():.1f}"
    )
    for one in wrong:
        print(f"  WRONG: {one}")


# -- other ways -------------------------------------------------------------------------------------------

# Of the orthophoto at this level; SIFT upright, rooted, one byte a number.
OTHER_LEVEL, PER_KM2, PER_FRAME, VOTES = 2, 4000, 300, 20
WORDS, PROJECTED, STEP_M, HALF_M = 32, 24, 40.0, 60.0


def sift_of(sift: Any, image: ImageArray, valid: np.ndarray, count: int) -> tuple[FloatArray, np.ndarray]:
    """Pixels (N, 2) and descriptors (N, 128) uint8 of the strongest, without their turn: all pictures are north-up."""
    inner = cv2.erode(valid.astype(np.uint8), np.ones((9, 9), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    strongest = sorted(sift.detect(image, inner), key=lambda one: -one.response)[:count]
    upright = {(round(k.pt[0], 1), round(k.pt[1], 1), k.octave): k for k in strongest}
    for one in upright.values():
        one.angle = 0.0
    kept, raw = sift.compute(image, list(upright.values()))
    if raw is None:
        return np.empty((0, 2)), np.empty((0, 128), np.uint8)
    rooted = np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-6))
    return np.array([one.pt for one in kept]), (rooted * 255).astype(np.uint8)


def others(args: argparse.Namespace) -> None:
    store = MapStore(Pack.open(args.pack), max_pixels=100_000_000)
    grid, sift, side = store.dop_grids[OTHER_LEVEL], cv2.SIFT_create(contrastThreshold=0.01), 1024
    began, px_parts, parts = time.process_time(), [], []
    for row in range(0, grid.height, side):
        for column in range(0, grid.width, side):
            piece = grid.crop(column, row, min(side, grid.width - column), min(side, grid.height - row))
            window = store.read(piece.bounds, grid.gsd_m, math.inf)
            if window is None or not window.dop_valid.any():
                continue
            count = round(PER_KM2 * window.dop_valid.sum() * grid.gsd_m**2 * 1e-6)
            px, found = sift_of(sift, window.dop_grey, window.dop_valid, count)
            px_parts.append(px + np.array([column, row]))
            parts.append(found)
    px, descriptors = np.concatenate(px_parts), np.concatenate(parts)
    print(f"SIFT: {len(px)} of the map, {descriptors.nbytes / 1e6:.1f} MB, {time.process_time() - began:.0f} s CPU")
    began = time.process_time()
    vlad = Vlad(px * grid.gsd_m, descriptors)
    made_s = time.process_time() - began
    print(f"VLAD: {len(vlad.middles_m)} windows, {vlad.bytes / 1e6:.1f} MB, {made_s:.0f} s CPU", flush=True)
    squares = np.concatenate([np.square(d.astype(np.float32)).sum(axis=1) for d in np.array_split(descriptors, 50)])
    by_votes, by_vlad, votes_s, vlad_s = [], [], [], []
    for number, (case, known) in enumerate(sightings(args.frames, args.heading, False)):
        if number == args.count:
            break
        to_ground = np.diag([grid.gsd_m, -grid.gsd_m, -known.above_ground_m])
        from_grid = CAMERA.matrix @ known.map_from_camera.T @ to_ground
        seen = rectified(known.grey, CAMERA, from_grid, 10**6)
        assert seen is not None
        corner = np.linalg.solve(from_grid, seen.frame_from_canvas)
        foot = -corner[:2, 2] / corner[2, 2]
        true = grid.px_from_map(case.pose.translation[:2])
        cpu = time.process_time()
        own_px, own = sift_of(sift, seen.image, seen.valid, PER_FRAME)
        extracted_s = time.process_time() - cpu
        if len(own) < VOTES:
            by_votes.append(999)
            by_vlad.append(999)
            continue
        places = voted(own_px - foot, own, px, descriptors, squares)
        votes_s.append(time.process_time() - cpu)
        by_votes.append(first(np.linalg.norm(places - true, axis=1) * grid.gsd_m < 20.0))
        cpu = time.process_time()
        middles = vlad.nearest(own)
        vlad_s.append(extracted_s + time.process_time() - cpu)
        # Windows lie 40 m apart.
        by_vlad.append(first(np.linalg.norm(middles - true * grid.gsd_m, axis=1) < 60.0))
    for name, found, cpu_s in (("SIFT, votes", by_votes, votes_s), ("VLAD", by_vlad, vlad_s)):
        told = ", ".join(f"R@{k} {np.mean(np.array(found) < k):.3f}" for k in RANKS)
        print(f"{name}: {len(found)} frames, {told}; CPU {np.median(cpu_s):.2f} s")


def first(near: np.ndarray) -> int:
    hits = np.flatnonzero(near)
    return int(hits[0]) if len(hits) else 999


def voted(
    offsets: FloatArray, own: np.ndarray, px: FloatArray, descriptors: np.ndarray, squares: np.ndarray
) -> FloatArray:
    """Pixels (20, 2) where most of the nearest descriptors put the camera."""
    distance = np.concatenate(
        [
            some_squares[None] - 2.0 * own.astype(np.float32) @ some.astype(np.float32).T
            for some, some_squares in zip(np.array_split(descriptors, 50), np.array_split(squares, 50), strict=True)
        ],
        axis=1,
    )
    nearest = np.argpartition(distance, VOTES, axis=1)[:, :VOTES]
    cells = np.floor((px[nearest] - offsets[:, None]).reshape(-1, 2) / 8.0).astype(int)
    votes = np.zeros(np.ceil(px.max(axis=0) / 8.0).astype(int)[::-1] + 2, np.float32)
    inside = ((cells >= 0) & (cells < votes.shape[::-1])).all(axis=1)
    np.add.at(votes, (cells[inside, 1], cells[inside, 0]), 1.0)
    votes = cv2.blur(votes, (3, 3), borderType=cv2.BORDER_CONSTANT)
    places = []
    for _ in range(max(RANKS)):
        row, column = divmod(int(votes.argmax()), votes.shape[1])
        places.append((8.0 * column + 3.5, 8.0 * row + 3.5))
        votes[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3] = -1.0
    return np.array(places)


class Vlad:
    """Windows of a map by the sums of their descriptors' residuals (Jegou 2010), each projected at random."""

    def __init__(self, places_m: FloatArray, descriptors: np.ndarray) -> None:
        rng = np.random.default_rng(0)
        sample = descriptors[rng.choice(len(descriptors), 8000, replace=False)].astype(np.float32)
        stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 15, 1.0)
        cv2.setRNGSeed(0)
        self._words = cv2.kmeans(sample, WORDS, None, stop, 1, cv2.KMEANS_PP_CENTERS)[2]
        self._projection = np.linalg.qr(rng.normal(size=(128, PROJECTED)))[0].astype(np.float32)
        quantised = [self._quantised(some) for some in np.array_split(descriptors, 50)]
        word, residual = (np.concatenate(part) for part in zip(*quantised, strict=True))
        columns, rows = np.ceil(places_m.max(axis=0) / STEP_M).astype(int) + 1
        sums = np.zeros((rows, columns, WORDS, PROJECTED), np.float32)
        cell = np.floor(places_m / STEP_M).astype(int)
        for shift in np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2):
            there = cell + shift
            inside = ((there >= 0) & (there < (columns, rows))).all(axis=1)
            inside &= (np.abs(places_m - (there + 0.5) * STEP_M) < HALF_M).all(axis=1)
            np.add.at(sums, (there[inside, 1], there[inside, 0], word[inside]), residual[inside])
        used = sums.any(axis=(2, 3))
        self._signatures = _normed(sums[used]).astype(np.float16)
        self.middles_m = (np.argwhere(used)[:, ::-1] + 0.5) * STEP_M

    @property
    def bytes(self) -> int:
        return int(self._signatures.nbytes)

    def nearest(self, own: np.ndarray) -> FloatArray:
        word, residual = self._quantised(own)
        sums = np.zeros((WORDS, PROJECTED), np.float32)
        np.add.at(sums, word, residual)
        alike = self._signatures.astype(np.float32) @ _normed(sums[None])[0]
        return np.asarray(self.middles_m[np.argsort(-alike)[: max(RANKS)]])

    def _quantised(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = some.astype(np.float32)
        word = np.argmin(np.square(self._words).sum(axis=1)[None] - 2.0 * values @ self._words.T, axis=1)
        return word, (values - self._words[word]) @ self._projection


def _normed(sums: np.ndarray) -> np.ndarray:
    by_word = sums / np.maximum(np.linalg.norm(sums, axis=-1, keepdims=True), 1e-6)
    flat = (np.sign(by_word) * np.sqrt(np.abs(by_word))).reshape(len(sums), -1)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-6))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    drawing = commands.add_parser("area")
    drawing.add_argument("out", type=Path)
    drawing.add_argument("--side-km", type=float, default=10.0)
    drawing.add_argument("--country", type=int, default=11, help="seed")
    drawing.set_defaults(run=area)
    making = commands.add_parser("frames")
    making.add_argument("pack", type=Path)
    making.add_argument("out", type=Path)
    making.add_argument("--look", choices=("flight", *map(str, SURVEYS)), default="flight")
    making.add_argument("--seed", type=int, default=2)
    making.add_argument("--country", type=int, default=11, help="seed; of another one the frames are not in the map")
    making.add_argument("--each", type=int, default=3, help="frames of a place")
    making.set_defaults(run=make)
    finding = commands.add_parser("find")
    finding.add_argument("--height", choices=("ground", "barometer"), default="ground")
    finding.add_argument(
        "--hostile", choices=("mirrored", "absent", "elsewhere"), help="elsewhere: frames of another country"
    )
    finding.add_argument("--use", type=int, default=1, help="frames of a place")
    finding.add_argument("--out", type=Path, required=True, help="JSON lines; a run that was ended goes on")
    finding.add_argument("--threads", type=int, default=2)
    finding.set_defaults(run=find)
    other = commands.add_parser("others")
    other.set_defaults(run=others)
    for one in (finding, other):
        one.add_argument("pack", type=Path)
        one.add_argument("frames", type=Path)
        one.add_argument("--heading", type=float, default=10.0)
    for one in (making, finding, other):
        one.add_argument("--count", type=int, default=40)
        one.add_argument("--agl", type=float, default=120.0)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    args.run(args)


if __name__ == "__main__":
    main()
