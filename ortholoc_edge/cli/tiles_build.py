"""`ortholoc-edge tiles build`: public geodata to an area pack."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ortholoc_edge.cli.tiles_inspect import print_facts
from ortholoc_edge.errors import ConfigError
from ortholoc_edge.parallel import Workers
from ortholoc_edge.tiles import features
from ortholoc_edge.tiles.area import read_area
from ortholoc_edge.tiles.build import PackOptions, Preview, build_pack, preview_build
from ortholoc_edge.tiles.signature import signer

_UNITS = {"": 1.0, "K": 1e3, "M": 1e6, "G": 1e9, "T": 1e12, "KI": 2.0**10, "MI": 2.0**20, "GI": 2.0**30}
_DEFAULTS = PackOptions()


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add `build` to the `tiles` subcommands."""
    build = actions.add_parser(
        "build",
        help="build a pack from orthophotos and surface models",
        description=(
            "Build an area pack from any mix of files and folders: GeoTIFF, COG, JPEG 2000, VRT, ZIP, images with world"
            " files, XYZ text, LAZ. Sources on the pack's pixel grid are copied pixel for pixel, others are warped"
            " once; the newest lies uppermost. A build that was cut off goes on where it was when it is started again."
            " Equal sources give equal bytes; SOURCE_DATE_EPOCH adds a time of creation."
        ),
    )
    build.add_argument("--dop", type=Path, nargs="+", required=True, metavar="PATH", help="orthophotos")
    build.add_argument(
        "--dsm", type=Path, nargs="+", required=True, metavar="PATH", help="surface models, heights in metres"
    )
    build.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of the new pack")
    build.add_argument("--force", action="store_true", help="replace the pack at --out (default: refuse)")
    build.add_argument("--dry-run", action="store_true", help="print what would be built and its size, and stop")
    build.add_argument("--json", action="store_true", help="facts of the pack as JSON (default: a table)")
    _add_place(build)
    _add_size(build)
    _add_heights(build)
    _add_sources(build)
    work = build.add_argument_group("work")
    work.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes (default: one per core)"
    )
    work.add_argument(
        "--dask",
        metavar="ADDRESS",
        help="run on the Dask cluster of this scheduler, as tcp://host:8786; sources and --out on a shared file system"
        " (needs: pip install 'ortholoc-edge[dask]')",
    )
    work.add_argument(
        "--sign",
        type=Path,
        metavar="KEY.pem",
        help="sign the pack with this Ed25519 private key (needs: pip install 'ortholoc-edge[sign]')",
    )
    build.set_defaults(run=run)


def _add_place(build: argparse.ArgumentParser) -> None:
    place = build.add_argument_group("place")
    place.add_argument(
        "--area",
        metavar="AREA",
        help="keep only this: W,S,E,N in degrees (or in metres of the pack), a GeoJSON file, or a route to follow:"
        " QGroundControl .plan, .waypoints, KML, KMZ (default: all that the sources cover)",
    )
    place.add_argument(
        "--corridor", type=float, metavar="M", help="width kept along a route, half to each side (default: 500)"
    )
    place.add_argument(
        "--crs",
        action="append",
        type=_named_crs,
        metavar="[PATTERN=]EPSG:N",
        help="CRS of sources that do not name theirs, all or those whose names fit the pattern, as '*_33_*=EPSG:25833';"
        " may be repeated, the first that fits counts; 'local' for local metres",
    )
    place.add_argument(
        "--pack-crs", metavar="EPSG:N", help="projected CRS of the pack (default: that of most of the orthophoto)"
    )


def _add_size(build: argparse.ArgumentParser) -> None:
    size = build.add_argument_group("size and quality")
    size.add_argument(
        "--max-size", type=_bytes, metavar="SIZE", help="of the pack, as 400MB; quality, then GSD give way"
    )
    size.add_argument("--dop-gsd", type=float, metavar="M", help="of the pack's orthophoto (default: the sources')")
    size.add_argument("--dsm-gsd", type=float, metavar="M", help="of the pack's surface model (default: the sources')")
    size.add_argument(
        "--dop-compression", choices=("webp", "jpeg"), default=_DEFAULTS.dop_compression, help="(default: %(default)s)"
    )
    size.add_argument(
        "--quality",
        type=int,
        default=_DEFAULTS.quality,
        help="of that compression, 1-100, WEBP is lossless at 100 (default: %(default)s)",
    )
    size.add_argument(
        "--max-z-error",
        type=float,
        metavar="M",
        help="largest height error by compression, metres (default: the lower of 0.05 and DSM GSD / 20)",
    )
    size.add_argument(
        "--max-hole",
        type=int,
        default=_DEFAULTS.max_hole_cells,
        metavar="CELLS",
        help="close holes of the surface model up to this size, where their rim is a plane (default: %(default)s)",
    )
    size.add_argument(
        "--features",
        choices=features.MATCHERS,
        help="precompute this matcher's features of the orthophoto (default: none)",
    )
    size.add_argument(
        "--features-per-mpx",
        type=float,
        default=_DEFAULTS.features_per_mpx,
        metavar="N",
        help="features kept per million pixels of each scale (default: %(default)g)",
    )


def _add_heights(build: argparse.ArgumentParser) -> None:
    heights = build.add_argument_group("heights")
    heights.add_argument(
        "--vertical",
        choices=("ellipsoid", "orthometric", "unknown"),
        help="what heights are measured from (default: what the surface models' CRS says; an error if it does not)",
    )
    heights.add_argument(
        "--vertical-epsg", type=int, metavar="N", help="vertical system of orthometric heights, as 7837 or 5703"
    )
    heights.add_argument(
        "--geoid-undulation-m",
        type=float,
        metavar="M",
        help="geoid above the ellipsoid in the area, metres (default: from PROJ if it has the grid)",
    )


def _add_sources(build: argparse.ArgumentParser) -> None:
    source = build.add_argument_group("about the sources")
    source.add_argument(
        "--dop-date",
        metavar="DATE",
        help="of acquisition: 2023, 2023-06 or 2023-06-04 (default: what tags or names of the files say)",
    )
    source.add_argument("--dsm-date", metavar="DATE", help="of acquisition, likewise")
    source.add_argument("--attribution", metavar="TEXT", help="whom to credit where the map is shown")
    source.add_argument("--licence", metavar="TEXT", help="of the sources, as dl-de/by-2-0")
    source.add_argument(
        "--true-ortho",
        action=argparse.BooleanOptionalAction,
        help="roofs stand upright over their walls, or lean (default: not known)",
    )
    source.add_argument("--dop-sigma-m", type=float, metavar="M", help="planimetric error, 1 sigma, metres")
    source.add_argument("--dsm-sigma-m", type=float, metavar="M", help="vertical error, 1 sigma, metres")


def run(args: argparse.Namespace) -> int:
    """Build, or say what would be built. Returns: the exit status. Raises: OrtholocError."""
    if args.jobs < 1:
        raise ConfigError(f"--jobs {args.jobs}: must be 1 or more")
    if args.corridor is not None and args.area is None:
        raise ConfigError(f"--corridor {args.corridor:g}: goes along a route; name one with --area FILE")
    options = PackOptions(
        dop_compression=args.dop_compression,
        quality=args.quality,
        max_z_error_m=args.max_z_error,
        dop_gsd_m=args.dop_gsd,
        dsm_gsd_m=args.dsm_gsd,
        max_size_bytes=args.max_size,
        area=None if args.area is None else read_area(args.area, args.corridor),
        source_crs=None if args.crs is None else tuple(args.crs),
        pack_crs=args.pack_crs,
        max_hole_cells=args.max_hole,
        features=args.features,
        features_per_mpx=args.features_per_mpx,
        vertical=args.vertical,
        vertical_epsg=args.vertical_epsg,
        geoid_undulation_m=args.geoid_undulation_m,
        dop_date=args.dop_date,
        dsm_date=args.dsm_date,
        attribution=args.attribution,
        licence=args.licence,
        true_ortho=args.true_ortho,
        dop_sigma_m=args.dop_sigma_m,
        dsm_sigma_m=args.dsm_sigma_m,
        force=args.force,
        created=_source_date(os.environ.get("SOURCE_DATE_EPOCH")),
    )
    # Before the pack takes its name: one that must be signed is never there without.
    finish = None if args.sign is None else signer(args.sign)
    if args.dry_run:
        _print_preview(preview_build(args.dop, args.dsm, args.out, options), args.json)
        return 0
    bar_format = "{l_bar}{bar}| {elapsed}, {remaining} left"
    with tqdm(total=100, file=sys.stderr, bar_format=bar_format, leave=False) as bar:

        def progress(fraction: float, message: str) -> None:
            bar.set_description_str(message, refresh=False)
            bar.update(max(100 * fraction - bar.n, 0))
            bar.refresh()

        workers = Workers(args.jobs, args.dask)
        pack = build_pack(args.dop, args.dsm, args.out, options, progress, workers, finish)
    print_facts(pack, as_json=args.json)
    if pack.manifest.vertical.amsl_minus_map_m is None:
        print(
            "No AMSL heights from this pack: its vertical datum is not known (--vertical, --geoid-undulation-m).",
            file=sys.stderr,
        )
    return 0


def _print_preview(preview: Preview, as_json: bool) -> None:
    plan, settings, estimate = preview.plan, preview.settings, preview.estimate
    west, south, east, north = plan.bounds
    facts: dict[str, Any] = {
        "crs": plan.crs,
        "extent_m": {"west": west, "south": south, "east": east, "north": north},
        "area_km2": round(plan.dop.pixels * plan.dop.lattice.pixel_m**2 / 1e6, 6),
        "dop": {
            "gsd_m": settings.dop_gsd_m,
            "tiles": len(plan.dop.tiles),
            "quality": settings.quality,
            "compression": settings.compression,
            "sources": len(plan.dop.sources),
            "resampled": sum(plan.dop.resampled(k, plan.crs) for k in range(len(plan.dop.sources))),
            "megabytes": round(estimate.dop_bytes / 1e6, 3),
        },
        "dsm": {
            "gsd_m": settings.dsm_gsd_m,
            "tiles": len(plan.dsm.tiles),
            "max_z_error_m": settings.max_z_error_m,
            "sources": len(plan.dsm.sources),
            "resampled": sum(plan.dsm.resampled(k, plan.crs) for k in range(len(plan.dsm.sources))),
            "megabytes": round(estimate.dsm_bytes / 1e6, 3),
        },
        "features_megabytes": round(estimate.feature_bytes / 1e6, 3),
        "megabytes": round(estimate.bytes / 1e6, 3),
        "megabytes_sigma": round(estimate.sigma_bytes / 1e6, 3),
    }
    if as_json:
        print(json.dumps(facts, indent=2))
        return
    dop, dsm = facts["dop"], facts["dsm"]
    rows = [
        ("CRS", plan.crs or "none, local metres"),
        ("extent", f"E {west:.1f} to {east:.1f}, N {south:.1f} to {north:.1f} m"),
        ("area", f"{facts['area_km2']:.4g} km2 in {dop['tiles']} + {dsm['tiles']} tiles"),
        (
            "DOP",
            f"{dop['gsd_m']:.4g} m/px, {dop['compression']} quality {dop['quality']}, from {dop['sources']} sources"
            f" ({dop['resampled']} resampled), about {dop['megabytes']:.2f} MB",
        ),
        (
            "DSM",
            f"{dsm['gsd_m']:.4g} m/px within {dsm['max_z_error_m']:g} m, from {dsm['sources']} sources"
            f" ({dsm['resampled']} resampled), about {dsm['megabytes']:.2f} MB",
        ),
    ]
    if facts["features_megabytes"]:
        rows.append(("features", f"about {facts['features_megabytes']:.2f} MB"))
    rows.append(("in all", f"about {facts['megabytes']:.2f} MB, give or take {facts['megabytes_sigma']:.2f}"))
    print("\n".join(f"{label:<12}{value}" for label, value in rows))


def _named_crs(text: str) -> tuple[str, str]:
    pattern, mark, crs = text.rpartition("=")
    # WKT and PROJ strings have equals signs of their own, patterns of file names have none.
    if not mark or any(c in pattern for c in "[+ "):
        return "*", text
    return pattern, crs


def _bytes(text: str) -> int:
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(KI|MI|GI|K|M|G|T|)B?\s*", text, re.IGNORECASE)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no size; write it as 400MB or 2GB")
    return int(float(match[1]) * _UNITS[match[2].upper()])


def _source_date(epoch: str | None) -> datetime | None:
    if not epoch:
        return None
    try:
        return datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as err:
        raise ConfigError(
            f"SOURCE_DATE_EPOCH {epoch!r}: must be seconds since 1970; correct or unset it"
        ) from err
