"""`ortholoc-edge tiles`: build, describe and verify area packs."""

from __future__ import annotations

import argparse
import json
import os
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
from tqdm import tqdm

from ortholoc_edge.errors import ConfigError
from ortholoc_edge.tiles.build import PackOptions, build_pack
from ortholoc_edge.tiles.manifest import RasterFile
from ortholoc_edge.tiles.pack import Pack


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the `tiles` subcommands."""
    tiles = subparsers.add_parser("tiles", help="build, describe and verify area packs", description=__doc__)
    actions = tiles.add_subparsers(dest="action", required=True, metavar="ACTION")
    _add_build(actions)

    info = actions.add_parser(
        "info", help="say what a pack holds", description="Say what an area pack holds."
    )
    info.add_argument("pack", type=Path, help="directory of the pack")
    info.add_argument("--json", action="store_true", help="as JSON (default: a table)")
    info.set_defaults(run=run)

    verify = actions.add_parser(
        "verify",
        help="check every byte and tile of a pack",
        description="Check every byte and decode every tile of a pack. Exit status 1 if anything is wrong.",
    )
    verify.add_argument("pack", type=Path, help="directory of the pack")
    verify.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the chosen action. Returns: the exit status. Raises: OrtholocError."""
    if args.action == "build":
        return _build(args)
    if args.action == "info":
        return _info(args)
    return _verify(args)


def _add_build(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    build = actions.add_parser(
        "build",
        help="build a pack from an orthophoto and a surface model",
        description=(
            "Build an area pack from an orthophoto (DOP) and a surface model (DSM), both in one projected"
            " CRS in"
            " metres or both in local metres without CRS. Both keep their own grids; nothing is resampled."
            " SOURCE_DATE_EPOCH sets the time of creation, for reproducible packs."
        ),
    )
    build.add_argument(
        "--dop", type=Path, required=True, metavar="FILE", help="orthophoto, 8 bits, grey or RGB"
    )
    build.add_argument(
        "--dsm", type=Path, required=True, metavar="FILE", help="surface model, heights in metres"
    )
    build.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory of the new pack")
    build.add_argument("--force", action="store_true", help="replace the pack at --out (default: refuse)")
    build.add_argument(
        "--dop-compression",
        choices=("webp", "jpeg"),
        default="webp",
        help="of the orthophoto (default: webp)",
    )
    build.add_argument("--quality", type=int, default=85, help="of that compression, 1-100 (default: 85)")
    build.add_argument(
        "--max-z-error",
        type=float,
        metavar="M",
        help="largest height error by compression, metres (default: the lower of 0.02 and DSM GSD / 20)",
    )
    heights = build.add_argument_group("heights")
    heights.add_argument(
        "--vertical",
        choices=("ellipsoid", "orthometric", "unknown"),
        help="what heights are measured from (default: what the DSM's CRS says, else unknown)",
    )
    heights.add_argument(
        "--vertical-epsg",
        type=int,
        metavar="N",
        help="vertical system of orthometric heights, as 7837 or 5703",
    )
    heights.add_argument(
        "--geoid-undulation-m",
        type=float,
        metavar="M",
        help="geoid above the ellipsoid in the area, metres (default: from PROJ if it has the grid)",
    )
    source = build.add_argument_group("about the sources")
    source.add_argument("--dop-date", metavar="DATE", help="of acquisition: 2023, 2023-06 or 2023-06-04")
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
    build.set_defaults(run=run)


def _build(args: argparse.Namespace) -> int:
    options = PackOptions(
        dop_compression=args.dop_compression,
        quality=args.quality,
        max_z_error_m=args.max_z_error,
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
    bar_format = "{l_bar}{bar}| {elapsed}"
    with tqdm(total=100, file=sys.stderr, bar_format=bar_format, leave=False) as bar:

        def progress(fraction: float, message: str) -> None:
            bar.set_description_str(message, refresh=False)
            bar.update(100 * fraction - bar.n)
            bar.refresh()

        pack = build_pack(args.dop, args.dsm, args.out, options, progress)
    print(_table(_facts(pack)))
    if pack.manifest.vertical.amsl_minus_map_m is None:
        print(
            "No AMSL heights from this pack: its vertical datum is not known well enough"
            " (--vertical, --geoid-undulation-m).",
            file=sys.stderr,
        )
    return 0


def _info(args: argparse.Namespace) -> int:
    facts = _facts(Pack.open(args.pack))
    print(json.dumps(facts, indent=2) if args.json else _table(facts))
    return 0


def _verify(args: argparse.Namespace) -> int:
    pack = Pack.open(args.pack)
    problems = pack.verify()
    for problem in problems:
        print(problem)
    if problems:
        return 1
    print(f"{args.pack}: sound, {sum(entry.bytes for entry in pack.rasters)} bytes")
    return 0


def _source_date(epoch: str | None) -> datetime | None:
    if not epoch:
        return None
    try:
        return datetime.fromtimestamp(int(epoch), UTC)
    except (ValueError, OverflowError, OSError) as err:
        raise ConfigError(
            f"SOURCE_DATE_EPOCH {epoch!r}: must be seconds since 1970; correct or unset it"
        ) from err


def _facts(pack: Pack) -> dict[str, Any]:
    manifest = pack.manifest
    bounds = manifest.dop.grid.raster_grid().bounds
    width_m, height_m = bounds[2] - bounds[0], bounds[3] - bounds[1]
    centre: dict[str, Any] = {
        "latitude_deg": None,
        "longitude_deg": None,
        "convergence_deg": 0.0,
        "grid_scale": 1.0,
    }
    if manifest.crs is not None:
        middle = ((bounds[0] + bounds[2]) / 2, (bounds[1] + bounds[3]) / 2)
        geodetic = pack.georeference.geodetic_from_map((*middle, 0.0))
        centre = {
            "latitude_deg": round(geodetic.lat_deg, 7),
            "longitude_deg": round(geodetic.lon_deg, 7),
            "convergence_deg": round(pack.georeference.convergence_rad(middle) * 57.29577951308232, 6),
            "grid_scale": round(pack.georeference.grid_scale(middle, 0.0), 9),
        }
    return {
        "pack": str(pack.path),
        "created": manifest.created,
        "crs": manifest.crs,
        "extent_m": {"west": bounds[0], "south": bounds[1], "east": bounds[2], "north": bounds[3]},
        "area_km2": round(width_m * height_m / 1e6, 9),
        "anchor_m": list(manifest.anchor),
        "centre": centre,
        "vertical": msgspec.to_builtins(manifest.vertical),
        "dop": _raster_facts(manifest.dop)
        | {"true_ortho": manifest.dop.true_ortho, "sigma_m": manifest.dop.sigma_m},
        "dsm": _raster_facts(manifest.dsm)
        | {"max_z_error_m": manifest.dsm.max_z_error_m, "sigma_m": manifest.dsm.sigma_m},
        "bytes": sum(entry.bytes for entry in pack.rasters),
    }


def _raster_facts(entry: RasterFile) -> dict[str, Any]:
    return {
        "file": entry.file,
        "gsd_m": entry.gsd_m,
        "size_px": [entry.grid.width, entry.grid.height],
        "levels": entry.levels,
        "compression": entry.compression,
        "coverage_percent": round(100 * entry.valid_fraction, 2),
        "bytes": entry.bytes,
        "date": entry.date,
        "attribution": entry.attribution,
        "licence": entry.licence,
        "source": entry.source,
    }


def _table(facts: dict[str, Any]) -> str:
    extent, centre, vertical = facts["extent_m"], facts["centre"], facts["vertical"]
    rows = [
        ("pack", facts["pack"]),
        ("created", facts["created"]),
        ("CRS", facts["crs"] or "none, local metres"),
        (
            "extent",
            f"E {extent['west']:.2f} to {extent['east']:.2f}, N {extent['south']:.2f} to"
            f" {extent['north']:.2f} m",
        ),
        ("area", f"{facts['area_km2']:.4g} km2"),
    ]
    if centre["latitude_deg"] is not None:
        rows += [
            ("centre", f"{centre['latitude_deg']:.6f}, {centre['longitude_deg']:.6f}"),
            ("grid", f"convergence {centre['convergence_deg']:+.3f} deg, scale {centre['grid_scale']:.6f}"),
        ]
    rows.append(("heights", " ".join(str(v) for v in (vertical["kind"], vertical["name"]) if v)))
    for name, key in (("to AMSL", "amsl_minus_map_m"), ("to ellipsoid", "ellipsoid_minus_map_m")):
        offset = vertical[key]
        rows.append((f"  {name}", "not known" if offset is None else f"{offset:+.2f} m"))
    if vertical["derivation"]:
        rows.append(("  derivation", vertical["derivation"]))
    for name in ("dop", "dsm"):
        rows += _raster_rows(name.upper(), facts[name])
    return "\n".join(f"{label:<16}{value}" for label, value in rows)


def _raster_rows(name: str, raster: dict[str, Any]) -> list[tuple[str, str]]:
    width, height = raster["size_px"]
    rows = [
        (name, f"{raster['gsd_m']:.4g} m/px, {width} x {height} px, {raster['levels']} levels"),
        ("  file", f"{raster['file']}, {raster['bytes'] / 1e6:.2f} MB, {raster['compression']}"),
        ("  coverage", f"{raster['coverage_percent']:.1f} %"),
    ]
    if name == "DOP":
        rows.append(("  true ortho", {True: "yes", False: "no", None: "not known"}[raster["true_ortho"]]))
    else:
        rows.append(("  max z error", f"{raster['max_z_error_m']:g} m by compression"))
    sigma = raster["sigma_m"]
    rows.append(("  sigma", "not known" if sigma is None else f"{sigma:g} m"))
    rows += [(f"  {key}", raster[key]) for key in ("date", "attribution", "licence", "source") if raster[key]]
    return rows
