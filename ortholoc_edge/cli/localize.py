"""``localize``: one photo, one answer."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from ortholoc_edge.adapters.camera import read_image
from ortholoc_edge.bench import draw
from ortholoc_edge.bench.replay import Length
from ortholoc_edge.cli import matcher_options
from ortholoc_edge.cli.arguments import any_triple, geodetic, length, map_position, sigma_triple, writable_folder
from ortholoc_edge.config import read_intrinsics
from ortholoc_edge.errors import CameraError, ConfigError, OrtholocError
from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames, rotation
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.localizer import Localizer, LocalizerOptions
from ortholoc_edge.pipeline.outcome import Fix, Outcome, Reason, Rejected
from ortholoc_edge.pipeline.prior import PosePrior, RegionPrior
from ortholoc_edge.pipeline.record import outcome_record
from ortholoc_edge.tiles.georeference import Georeference
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore

# Larger packs are not searched whole: that is area search, not localization.
MAX_UNAIDED_SIDE_M = 1000.0
_UNKNOWN_HEADING_SIGMA_RAD = math.pi
_ASSUMED_TILT_SIGMA_DEG = 10.0


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "localize",
        help="localize one photo",
        description="One photo, one answer. With --position the search starts there; with --attitude too, in the "
        "predicted view. Without either the whole pack is the region, in four rotations, if it is no larger than "
        f"{MAX_UNAIDED_SIDE_M:.0f} m. Exit code 0: a fix; 1: none.",
    )
    parser.add_argument("image", type=Path, metavar="IMAGE")
    parser.add_argument("--pack", type=Path, required=True)
    parser.add_argument(
        "--intrinsics",
        type=Path,
        metavar="K.json",
        help='width_px, height_px, fx, fy, cx, cy[, distortion], or {"intrinsics": 3x3}; needed without --calibrate',
    )
    parser.add_argument(
        "--position",
        type=map_position,
        metavar="E,N,H",
        help="predicted camera position in the pack's CRS and vertical datum, m; write --position=-1,2,3 if it begins "
        "with a minus",
    )
    parser.add_argument(
        "--geodetic",
        type=geodetic,
        metavar="LAT,LON,AMSL",
        help="the same as WGS 84 degrees and height above sea level; likewise --geodetic=-33.86,151.21,90",
    )
    parser.add_argument(
        "--position-sigma",
        type=length,
        default=Length(metres=5.0),
        metavar="LENGTH",
        help="horizontal 1-sigma: metres, or a part of the height above ground, 5%% (default: 5m)",
    )
    parser.add_argument(
        "--height-sigma", type=length, default=Length(metres=5.0), metavar="LENGTH", help="vertical (default: 5m)"
    )
    parser.add_argument(
        "--attitude",
        # NaN is what an autopilot without an attitude says: an answer with a reason, not a usage error.
        type=any_triple,
        metavar="R,P,Y",
        help="roll, pitch and yaw from true north of the body, degrees; the camera looks straight down, image top "
        "toward the nose. Left out: level, heading unknown",
    )
    parser.add_argument(
        "--attitude-sigma-deg",
        type=sigma_triple,
        default=(1.0, 1.0, 3.0),
        metavar="R,P,Y",
        help="1-sigma (default: 1,1,3)",
    )
    parser.add_argument("--calibrate", action="store_true", help="solve for the focal length too")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--overlay", type=Path, metavar="PNG", help="draw the matched points on the photo")
    # A single photo often comes without an attitude, or without any position.
    matcher_options.add(parser, default="structural+sift")
    matcher_options.add_features(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.overlay is not None:
        if args.overlay.is_dir():
            raise OrtholocError(f"{args.overlay}: is a folder; choose another --overlay, the name of a PNG file")
        writable_folder(args.overlay.parent, "--overlay")
    try:
        image = read_image(args.image)
    except CameraError as error:
        return _answer(args, Rejected(0, Reason.BAD_FRAME, str(error)), None)
    height, width = image.shape[:2]
    if args.intrinsics is not None:
        camera = read_intrinsics(args.intrinsics, width, height)
    elif args.calibrate:
        # Paper, appendix "Optimization of Camera Parameters": f = max(W, H) to begin with.
        camera = Camera.from_focal(width, height, float(max(width, height)))
    else:
        raise ConfigError("--intrinsics is missing; give it, or --calibrate to solve for the focal length")
    with MapStore(Pack.open(args.pack), features=args.features != "never") as store:
        prior = _prior(args, store)
        if isinstance(prior, Rejected):
            return _answer(args, prior, None)
        options = LocalizerOptions(
            adhop=not args.no_adhop, calibrate=args.calibrate, precomputed_features=args.features
        )
        localizer = Localizer(camera, store, matcher_options.matcher(args), options)
        try:
            outcome = localizer.localize(Frame(0, image, args.image.name), prior)
        finally:
            localizer.close()
        if args.overlay is not None:
            caption = f"{args.image.name}: " + sentence(outcome, store.pack.georeference)[0]
            draw.write_png(args.overlay, draw.overlay(image, outcome, None, camera, caption))
        return _answer(args, outcome, store.pack.georeference)


def _prior(args: argparse.Namespace, store: MapStore) -> PosePrior | RegionPrior | Rejected:
    georeference = store.pack.georeference
    if args.position is not None and args.geodetic is not None:
        raise ConfigError("--position and --geodetic say the same; give one")
    attitude = args.attitude
    if attitude is not None and not np.isfinite(attitude).all():
        return Rejected(0, Reason.BAD_ATTITUDE, f"--attitude {attitude} is not finite")
    position = args.position
    if args.geodetic is not None:
        latitude, longitude, amsl_m = args.geodetic
        position = georeference.map_from_geodetic(latitude, longitude, height_amsl_m=amsl_m)
    if position is None:
        if attitude is not None:
            raise ConfigError("--attitude needs --position or --geodetic beside it")
        west, south, east, north = store.bounds
        side_m = max(east - west, north - south)
        if side_m > MAX_UNAIDED_SIDE_M:
            return Rejected(
                0,
                Reason.NO_PRIOR,
                "the pack is too large to be searched whole; give --position; side, m",
                side_m,
                MAX_UNAIDED_SIDE_M,
            )
        return RegionPrior(store.bounds)
    position = np.array(position, dtype=np.float64)
    below = float(store.heights(position[None, :2])[0])
    above_m = position[2] - below if math.isfinite(below) else 0.0
    horizontal_m, vertical_m = args.position_sigma.at(above_m), args.height_sigma.at(above_m)
    sigma_deg = args.attitude_sigma_deg
    if attitude is None:
        attitude = (0.0, 0.0, 0.0)
        sigma_deg = (_ASSUMED_TILT_SIGMA_DEG, _ASSUMED_TILT_SIGMA_DEG, math.degrees(_UNKNOWN_HEADING_SIGMA_RAD))
    roll, pitch, yaw = np.radians(attitude)
    map_from_ned = frames.map_from_ned_rotation(georeference.convergence_rad(position[:2]))
    map_from_body = map_from_ned @ rotation.from_euler(roll, pitch, yaw)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag(np.square([horizontal_m, horizontal_m, vertical_m]))
    covariance[3:, 3:] = cov.attitude(map_from_body, tuple(np.radians(sigma_deg)))
    return PosePrior(Rigid3(map_from_body @ frames.BODY_FROM_NADIR_CAMERA, position), covariance)


def _answer(args: argparse.Namespace, outcome: Outcome, georeference: Georeference | None) -> int:
    if args.json:
        record = outcome_record(outcome)
        if isinstance(outcome, Fix) and georeference is not None:
            record |= georeferenced(outcome, georeference)
        print(json.dumps(record))
    else:
        print("\n".join(sentence(outcome, georeference)))
    return 0 if isinstance(outcome, Fix) else 1


def georeferenced(fix: Fix, georeference: Georeference) -> dict[str, Any]:
    """Attitude from true north, and WGS 84 where the pack has a reference system."""
    position = fix.map_from_camera.translation
    map_from_ned = frames.map_from_ned_rotation(georeference.convergence_rad(position[:2]))
    map_from_body = fix.map_from_camera.rotation @ frames.BODY_FROM_NADIR_CAMERA.T
    attitude = np.degrees(rotation.to_euler(map_from_ned.T @ map_from_body))
    record: dict[str, Any] = {"attitude_rpy_true_north_deg": attitude.tolist()}
    if georeference.crs is not None:
        place = georeference.geodetic_from_map(position)
        record |= {
            "latitude_deg": place.lat_deg,
            "longitude_deg": place.lon_deg,
            "height_amsl_m": place.height_amsl_m,
            "height_ellipsoid_m": place.height_ellipsoid_m,
        }
    return record


def sentence(outcome: Outcome, georeference: Georeference | None) -> list[str]:
    if not isinstance(outcome, Fix):
        limit = "" if outcome.limit is None else f" ({outcome.measured:.3g}, limit {outcome.limit:.3g})"
        return [f"no fix: {outcome.reason}: {outcome.detail}{limit}"]
    east, north, height = outcome.map_from_camera.translation
    sigma = np.sqrt(np.diag(outcome.covariance))
    lines = [
        f"fix: E {east:.2f} N {north:.2f} H {height:.2f} m, 1-sigma {sigma[0]:.2f} {sigma[1]:.2f} {sigma[2]:.2f} m",
        f"{outcome.inliers} of {outcome.matches} matches agree, {outcome.rms_px:.2f} px rms",
    ]
    if outcome.focal_sigma_px is not None:
        lines.append(f"focal length {outcome.camera.focal_px:.1f} px, 1-sigma {outcome.focal_sigma_px:.1f} px")
    if georeference is not None:
        known = georeferenced(outcome, georeference)
        roll, pitch, yaw = known["attitude_rpy_true_north_deg"]
        lines.append(f"body roll {roll:.2f} pitch {pitch:.2f} yaw {yaw:.2f} deg from true north")
        if "latitude_deg" in known:
            amsl = known["height_amsl_m"]
            lines.append(
                f"WGS 84 {known['latitude_deg']:.7f} {known['longitude_deg']:.7f}"
                + ("" if amsl is None else f", {amsl:.2f} m above sea level")
            )
    return lines
