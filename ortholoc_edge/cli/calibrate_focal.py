"""``calibrate-focal``: the focal length of a camera, from photos of a mapped place."""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from ortholoc_edge.bench import calibration as photos
from ortholoc_edge.bench import sequence
from ortholoc_edge.bench.calibration import KnownBeside, MatchedPhoto, Photo
from ortholoc_edge.bench.samples import sample_paths
from ortholoc_edge.cli import matcher_options
from ortholoc_edge.cli.arguments import positive, seed, triple, within, writable_folder
from ortholoc_edge.cli.localize import MAX_UNAIDED_SIDE_M
from ortholoc_edge.errors import ConfigError, DatasetError, OrtholocError
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.pipeline.calibration import Calibrated, NotCalibrated, calibrate_photos
from ortholoc_edge.pipeline.outcome import Rejected
from ortholoc_edge.pose.calibrate import Calibration, Unknowns, View
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "calibrate-focal",
        help="find a camera's focal length from photos of a mapped place",
        description="Matches photos of one camera with the map and solves for its focal length and principal point, "
        "jointly, with a pose for each. Several photos tell more than one: straight down over flat ground a longer "
        "lens from higher up makes the same picture, and such an answer is refused. SOURCE is photos, a folder with a "
        "*_flight.csv, OrthoLoC samples (.npz) or a folder of these; of the last three the recorded camera is what "
        "the answer is compared with. Exit code 0: calibrated; 1: not.",
    )
    parser.add_argument("source", type=Path, nargs="+", metavar="SOURCE")
    parser.add_argument(
        "--pack", type=Path, help="area pack; samples bring their own map, a flight's folder may hold its rasters"
    )
    parser.add_argument(
        "--around",
        type=triple,
        metavar="E,N,RADIUS",
        help="where plain photos were taken: centre and half side of a square, m in the pack's CRS (default: the whole "
        "pack)",
    )
    parser.add_argument(
        "--focal-px", type=positive, help="where to begin, px (default: the long side of the image, as in the paper)"
    )
    parser.add_argument(
        "--principal-point-sigma",
        type=within("a share of the image", float, 0.0, 1.0),
        default=0.01,
        metavar="SHARE",
        help="how far from the middle of the image the principal point may be, 1-sigma over the long side; 0: it is in "
        "the middle (default: %(default)s)",
    )
    parser.add_argument(
        "--radial", type=int, choices=(0, 1, 2), default=0, help="terms of radial distortion (default: %(default)s)"
    )
    parser.add_argument(
        "--height-sigma",
        type=positive,
        default=math.inf,
        metavar="M",
        help="take the recorded heights as a barometer's with this 1-sigma, their errors drawn for each photo by "
        "itself (a real barometer's are alike through a flight)",
    )
    parser.add_argument(
        "--tilt-sigma-deg",
        type=positive,
        default=math.inf,
        metavar="DEG",
        help="take the recorded roll and pitch as known with this 1-sigma, their errors drawn",
    )
    parser.add_argument("--each", action="store_true", help="calibrate with each photo alone, too")
    parser.add_argument("--seed", type=seed, default=0, help="of all drawing (default: %(default)s)")
    parser.add_argument("--out", type=Path, metavar="K.json", help="write the intrinsics there, for --intrinsics")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    # Photos without a predicted pose: SIFT bears any turn, and needs no model.
    matcher_options.add(parser, default="sift")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.out is not None:
        writable_folder(args.out.parent, "--out")
    matched = list(_matched(args))
    views = {one.name: one.outcome for one in matched if isinstance(one.outcome, View)}
    camera = photos.start_camera(matched[0].size, args.focal_px)
    unknowns = Unknowns(principal_point_sigma=args.principal_point_sigma, radial=args.radial)

    def solved(some: Mapping[str, View]) -> Calibrated | NotCalibrated:
        return calibrate_photos(some, camera, unknowns, seed=args.seed)

    joint = solved(views)
    alone = {name: solved({name: view}) for name, view in views.items()} if args.each else {}
    record = _record(joint, matched, alone)
    if args.out is not None and isinstance(joint, Calibrated):
        try:
            args.out.write_text(json.dumps(_intrinsics(joint.found.camera)) + "\n", encoding="utf-8")
        except OSError as err:
            raise OrtholocError(f"{args.out}: can't be written ({err}); choose another --out") from err
    print(json.dumps(record) if args.json else _text(record))
    return 0 if isinstance(joint, Calibrated) else 1


# -- photos ------------------------------------------------------------------------------------------------


def _matched(args: argparse.Namespace) -> Iterator[MatchedPhoto]:
    known = KnownBeside(args.height_sigma, math.radians(args.tilt_sigma_deg))
    with ExitStack() as stack:
        found, total = _photos(args, stack)
        matcher = matcher_options.matcher(args)
        matches = photos.match(found, matcher, args.focal_px, not args.no_adhop, known, args.seed)
        yield from tqdm(matches, total=total, desc=matcher.name, unit="photo", leave=False)


def _photos(args: argparse.Namespace, stack: ExitStack) -> tuple[Iterator[Photo], int]:
    """Raises: DatasetError or ConfigError for sources of several kinds or without a map."""
    missing = [path for path in args.source if not path.exists()]
    if missing:
        raise DatasetError(f"{missing[0]}: no such file or folder")
    store = None if args.pack is None else stack.enter_context(MapStore(Pack.open(args.pack)))
    samples = [path for source in args.source for path in sample_paths(source)]
    folders = [source for source in args.source if source.is_dir()]
    if samples:
        if any(not sample_paths(source) for source in args.source):
            raise ConfigError("samples and other sources together: calibrate one camera at a time")
        return photos.sample_photos(samples, store), len(samples)
    if folders:
        if len(args.source) > 1:
            raise ConfigError(f"{folders[0]} and other sources together: give one flight's folder, or photos")
        recorded = sequence.read_flight(folders[0])
        return photos.flight_photos(recorded, store or _own_map(folders[0], stack), args.seed), len(recorded)
    if store is None:
        raise ConfigError("--pack is missing; build one with: ortholoc-edge tiles build --dop … --dsm … --out PACK")
    if math.isfinite(min(args.height_sigma, args.tilt_sigma_deg)):
        raise ConfigError("--height-sigma and --tilt-sigma-deg are of recorded poses, which plain photos don't have")
    return photos.plain_photos(args.source, store, _around(args, store)), len(args.source)


def _own_map(folder: Path, stack: ExitStack) -> MapStore:
    """Of the rasters beside a flight, built anew."""
    dop, dsm = sorted(folder.glob("*_dop.tif")), sorted(folder.glob("*_dsm.tif"))
    if len(dop) != 1 or len(dsm) != 1:
        raise ConfigError(f"{folder}: --pack is missing, and there are no *_dop.tif and *_dsm.tif beside the flight")
    scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="ortholoc-calibrate-")))
    options = PackOptions(quality=85, vertical="unknown")
    return stack.enter_context(MapStore(build_pack(dop[0], dsm[0], scratch / "pack", options)))


def _around(args: argparse.Namespace, store: MapStore) -> Bounds:
    if args.around is None:
        west, south, east, north = store.bounds
        if max(east - west, north - south) > MAX_UNAIDED_SIDE_M:
            raise ConfigError(
                f"{args.pack} is {max(east - west, north - south):.0f} m wide, and no more than "
                f"{MAX_UNAIDED_SIDE_M:.0f} m are searched for a photo; give --around"
            )
        return store.bounds
    east, north, radius_m = args.around
    if radius_m <= 0:
        raise ConfigError(f"--around: radius {radius_m} m is not above zero")
    return east - radius_m, north - radius_m, east + radius_m, north + radius_m


# -- answers -----------------------------------------------------------------------------------------------


def _intrinsics(camera: Camera) -> dict[str, Any]:
    keys = ("fx", "fy", "cx", "cy")
    numbers = {key: float(getattr(camera, key)) for key in keys}
    distortion = [] if camera.is_pinhole else [float(term) for term in camera.distortion]
    size = {"width_px": camera.width, "height_px": camera.height}
    return {**size, **numbers, **({"distortion": distortion} if distortion else {})}


def _record(
    joint: Calibrated | NotCalibrated, matched: list[MatchedPhoto], alone: Mapping[str, Calibrated | NotCalibrated]
) -> dict[str, Any]:
    truth = {one.name: one.camera for one in matched}
    views = {one.name: one.outcome for one in matched if isinstance(one.outcome, View)}
    per_photo: dict[str, dict[str, Any]] = {one.name: {"name": one.name} for one in matched}
    for one in matched:
        if isinstance(one.outcome, Rejected):
            per_photo[one.name] |= {"reason": str(one.outcome.reason), "detail": one.outcome.detail}
    for name, refusal in joint.dropped.items():
        per_photo[name] |= {
            "reason": str(refusal.reason),
            "detail": refusal.detail,
            "measured": refusal.measured,
            "limit": refusal.limit,
        }
    if joint.found is not None:
        for name, estimate in zip(joint.names, joint.found.views, strict=True):
            if estimate is None:
                continue
            ground_m = float(np.median(views[name].points[estimate.inliers, 2]))
            per_photo[name] |= {
                "matches": len(estimate.inliers),
                "inliers": int(np.count_nonzero(estimate.inliers)),
                "rms_px": estimate.rms_px,
                "height_above_ground_m": float(estimate.local_from_camera.translation[2]) - ground_m,
                "focal_distance_correlation": estimate.focal_height_correlation,
            }
    for name, answer in alone.items():
        per_photo[name]["alone"] = _answer(answer, truth[name])
    cameras = set(truth.values())
    shared = cameras.pop() if len(cameras) == 1 else None
    return {**_answer(joint, shared), "photos": list(per_photo.values())}


def _answer(answer: Calibrated | NotCalibrated, truth: Camera | None) -> dict[str, Any]:
    record: dict[str, Any] = {"calibrated": isinstance(answer, Calibrated)}
    if isinstance(answer, NotCalibrated):
        record |= {
            "reason": str(answer.reason),
            "detail": answer.detail,
            "measured": answer.measured,
            "limit": answer.limit,
            "remedy": answer.remedy,
        }
    if answer.found is not None:
        record |= _figures(answer.found)
        if truth is not None:
            record["true_focal_px"] = truth.focal_px
            record["error_percent"] = 100.0 * (answer.found.camera.focal_px / truth.focal_px - 1.0)
    return record


def _figures(found: Calibration) -> dict[str, Any]:
    camera = found.camera
    return {
        "photos_used": len(found.views),
        "focal_px": camera.focal_px,
        "focal_sigma_px": camera.focal_px * found.sigma("log_focal"),
        "intrinsics": _intrinsics(camera),
        "sigmas": {name: found.sigma(name) for name in found.unknowns.names if name != "log_focal"},
        "map_height_sigma_m": found.height_sigma_m,
    }


def _text(record: Mapping[str, Any]) -> str:
    lines = [_photo_line(photo) for photo in record["photos"]]
    return "\n".join([*lines, "", *_answer_lines(record)])


def _answer_lines(record: Mapping[str, Any]) -> list[str]:
    if not record["calibrated"]:
        return [
            f"not calibrated: {record['reason']}: {record['detail']} ({record['measured']:.3g}, limit "
            f"{record['limit']:.3g})",
            f"what helps: {record['remedy']}",
        ]
    intrinsics, sigmas = record["intrinsics"], record["sigmas"]
    lines = [f"{_focal(record)} from {record['photos_used']} photo{'s' if record['photos_used'] > 1 else ''}"]
    if "cx" in sigmas:
        lines.append(
            f"principal point {intrinsics['cx']:.1f}, {intrinsics['cy']:.1f} px, 1-sigma {sigmas['cx']:.1f}, "
            f"{sigmas['cy']:.1f} px"
        )
    for number, name in enumerate(name for name in ("k1", "k2") if name in sigmas):
        lines.append(f"{name} {intrinsics.get('distortion', [0.0] * 5)[number]:.5f}, 1-sigma {sigmas[name]:.5f}")
    lines.append(f"the map's heights are good to {record['map_height_sigma_m']:.2f} m (1-sigma)")
    return lines


def _focal(record: Mapping[str, Any]) -> str:
    relative = 100.0 * record["focal_sigma_px"] / record["focal_px"]
    text = f"focal length {record['focal_px']:.1f} px, 1-sigma {record['focal_sigma_px']:.1f} px ({relative:.2f} %)"
    if "true_focal_px" in record:
        text += f", recorded {record['true_focal_px']:.1f} px: {record['error_percent']:+.2f} %"
    return text


def _photo_line(photo: Mapping[str, Any]) -> str:
    if "inliers" in photo:
        line = (
            f"{photo['name']}: {photo['inliers']} of {photo['matches']} matches agree, {photo['rms_px']:.2f} px rms, "
            f"{photo['height_above_ground_m']:.1f} m above ground, correlation of focal length and distance "
            f"{photo['focal_distance_correlation']:.3f}"
        )
    else:
        line = f"{photo['name']}: not used: {photo['reason']}: {photo['detail']}"
    if "alone" in photo:
        alone = photo["alone"]
        told = _focal(alone) if alone["calibrated"] else _answer_lines(alone)[0]
        line += f"\n  alone: {told}"
    return line
