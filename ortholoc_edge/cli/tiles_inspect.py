"""``tiles info`` and ``tiles verify``: what a pack holds, and whether it is sound."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from ortholoc_edge.cli.progress import ProgressBar
from ortholoc_edge.tiles.manifest import (
    SIGNATURE_NAME,
    VERSION,
    Dop,
    Dsm,
    FeatureLayer,
    layer_bounds,
    valid_fraction,
)
from ortholoc_edge.tiles.pack import Pack


def add_parser(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add both subcommands."""
    info = actions.add_parser(
        "info",
        help="say what a pack holds",
        description="Say what an area pack holds, from its manifest; its files are not read.",
    )
    info.add_argument("pack", type=Path, help="directory of the pack")
    info.add_argument("--json", action="store_true", help="as JSON (default: a table)")
    info.set_defaults(run=_info)

    verify = actions.add_parser(
        "verify",
        help="check every byte of a pack",
        description="Check every byte of every file of a pack, decode every block of every level, and look for files"
        " that are none of its. Prints what is wrong, a line each; exit status 1 if anything is.",
    )
    verify.add_argument("pack", type=Path, help="directory of the pack")
    verify.add_argument(
        "--public-key", type=Path, metavar="FILE", help="PEM; the pack must be signed with its private key"
    )
    verify.set_defaults(run=_verify)


def _info(args: argparse.Namespace) -> int:
    print_facts(Pack.open(args.pack), as_json=args.json)
    return 0


def _verify(args: argparse.Namespace) -> int:
    pack = Pack.open(args.pack, args.public_key)
    with ProgressBar("verifying") as bar:
        problems = pack.verify(bar.step)
    for problem in problems:
        print(problem)
    if problems:
        return 1
    signed = f", signed with the key of {args.public_key}" if pack.signed else ""
    print(f"{args.pack}: sound, {len(pack.manifest.notes())} files, {pack.total_bytes} bytes{signed}")
    return 0


def print_facts(pack: Pack, *, as_json: bool) -> None:
    """What a pack holds, to stdout."""
    facts = pack_facts(pack)
    print(json.dumps(facts, indent=2, ensure_ascii=False) if as_json else pack_table(facts))


def pack_facts(pack: Pack) -> dict[str, Any]:
    """What a person or a program wants to know of a pack, as plain values for JSON."""
    manifest = pack.manifest
    west, south, east, north = layer_bounds(manifest.dop)
    dop, dsm, features = _dop_facts(manifest.dop), _dsm_facts(manifest.dsm), _feature_facts(manifest.features)
    feature_bytes = 0 if features is None else features["bytes"]
    area = dop["area_km2"]
    return {
        "pack": str(pack.path),
        "format": VERSION,
        "created": manifest.created,
        "crs": manifest.crs,
        "extent_m": {"west": west, "south": south, "east": east, "north": north},
        "extent_deg": _extent_deg(pack, (west, south, east, north)),
        "area_km2": area,
        "anchor_m": list(manifest.anchor),
        "centre": _centre_facts(pack, ((west + east) / 2, (south + north) / 2)),
        "vertical": msgspec.to_builtins(manifest.vertical) | {"by_tile": _offset_facts(manifest.dsm)},
        "dop": dop,
        "dsm": dsm,
        "features": features,
        "alignment": None if manifest.alignment is None else msgspec.to_builtins(manifest.alignment),
        "files": [note.file for note in manifest.files],
        "bytes": pack.total_bytes,
        "memory_bytes": dop["bytes"] + dsm["bytes"] + feature_bytes,
        "mb_per_km2": {
            "without_features": _per_km2(dop["bytes"] + dsm["bytes"], area),
            "with_features": None if features is None else _per_km2(dop["bytes"] + dsm["bytes"] + feature_bytes, area),
        },
        "signature": (pack.path / SIGNATURE_NAME).is_file(),
        "missing": sorted(pack.missing),
    }


def pack_table(facts: dict[str, Any]) -> str:
    """`pack_facts` for a person, a line each."""
    extent, degrees, centre = facts["extent_m"], facts["extent_deg"], facts["centre"]
    per_km2 = facts["mb_per_km2"]
    rows = [
        ("pack", f"{facts['pack']}, format {facts['format']}"),
        ("created", facts["created"] or "not dated (SOURCE_DATE_EPOCH was not set)"),
        ("CRS", facts["crs"] or "none, local metres"),
        (
            "extent",
            f"E {extent['west']:.1f} to {extent['east']:.1f}, N {extent['south']:.1f} to {extent['north']:.1f} m",
        ),
    ]
    if degrees is not None:
        rows.append(
            (
                "",
                f"{degrees['south']:.5f} to {degrees['north']:.5f} N, {degrees['west']:.5f} to {degrees['east']:.5f} E",
            )
        )
    if centre is not None:
        rows.append(
            (
                "grid",
                f"convergence {centre['convergence_deg']:+.3f} deg, scale {centre['grid_scale']:.6f} at the centre",
            )
        )
    rows += [
        ("data", f"{facts['area_km2']:.4g} km2"),
        ("size", f"{facts['bytes'] / 1e6:.2f} MB, of which {facts['memory_bytes'] / 1e6:.2f} MB in memory in flight"),
    ]
    if per_km2["without_features"] is not None:
        more = "" if per_km2["with_features"] is None else f", {per_km2['with_features']:.2f} with features"
        rows.append(("", f"{per_km2['without_features']:.2f} MB per km2 of DOP and DSM{more}"))
    rows += _vertical_rows(facts["vertical"])
    rows += _layer_rows("DOP", facts["dop"])
    rows += _layer_rows("DSM", facts["dsm"])
    rows += _feature_rows(facts["features"])
    alignment = facts["alignment"]
    rows.append(
        (
            "alignment",
            "not measured"
            if alignment is None
            else f"DSM belongs {alignment['east_m']:+.2f} m east, {alignment['north_m']:+.2f} m north of where it is,"
            f" +-{alignment['sigma_m']:.2f} m, {alignment['samples']} patches",
        )
    )
    rows.append(("signature", "present, not checked (verify --public-key)" if facts["signature"] else "none"))
    if facts["missing"]:
        rows.append(("MISSING", f"{len(facts['missing'])} files, the first {facts['missing'][0]}"))
    return "\n".join(f"{label:<16}{value}" for label, value in rows)


# -- facts ---------------------------------------------------------------------------------------------


def _layer_facts(layer: Dop | Dsm) -> dict[str, Any]:
    lattice = layer.lattice
    pixels = sum(tile.width * tile.height for tile in layer.tiles)
    valid = valid_fraction(layer)
    dates = sorted({source.date for source in layer.sources if source.date is not None})
    return {
        "gsd_m": lattice.pixel_m,
        "levels_m": [lattice.pixel_m * 2**level for level in range(lattice.levels)],
        "tiles": len(layer.tiles),
        "tile_px": lattice.tile_px,
        "tile_m": lattice.tile_px * lattice.pixel_m,
        "area_km2": round(pixels * valid * lattice.pixel_m**2 / 1e6, 6),
        "coverage_percent": round(100 * valid, 2),
        "compression": layer.compression,
        "bytes": sum(tile.bytes for tile in layer.tiles),
        "date": layer.date,
        "source_dates": [dates[0], dates[-1]] if dates else None,
        "sources": [msgspec.to_builtins(source) for source in layer.sources],
        "attribution": layer.attribution,
        "licence": layer.licence,
    }


def _dop_facts(dop: Dop) -> dict[str, Any]:
    rated = [(tile.matchability, tile.width * tile.height) for tile in dop.tiles if tile.matchability is not None]
    total = sum(pixels for _, pixels in rated)
    return _layer_facts(dop) | {
        "true_ortho": dop.true_ortho,
        "sigma_m": dop.sigma_m,
        "matchability": round(sum(value * n for value, n in rated) / total, 4) if total else None,
    }


def _dsm_facts(dsm: Dsm) -> dict[str, Any]:
    known = [tile for tile in dsm.tiles if tile.valid_fraction > 0]
    pixels = sum(tile.width * tile.height for tile in dsm.tiles)
    filled = sum(tile.filled_fraction * tile.width * tile.height for tile in dsm.tiles)
    return _layer_facts(dsm) | {
        "height_m": [min(t.min_m for t in known), max(t.max_m for t in known)] if known else None,
        "max_z_error_m": dsm.max_z_error_m,
        "filled_percent": round(100 * filled / pixels, 3),
        "sigma_m": dsm.sigma_m,
    }


def _feature_facts(features: FeatureLayer | None) -> dict[str, Any] | None:
    if features is None:
        return None
    return {
        "matcher": features.matcher,
        "model_sha256": features.model_sha256,
        "encoding": features.encoding,
        "per_mpx": features.per_mpx,
        "tiles": len(features.tiles),
        "count": sum(sum(tile.counts) for tile in features.tiles),
        "bytes": sum(tile.bytes for tile in features.tiles),
    }


def _offset_facts(dsm: Dsm) -> dict[str, list[float] | None]:
    return {
        name: _range([offset for tile in dsm.tiles if (offset := getattr(tile, name)) is not None])
        for name in ("amsl_minus_map_m", "ellipsoid_minus_map_m")
    }


def _range(values: Sequence[float]) -> list[float] | None:
    return [min(values), max(values)] if values else None


def _extent_deg(pack: Pack, bounds: tuple[float, float, float, float]) -> dict[str, float] | None:
    if pack.georeference.crs is None:
        return None
    west, south, east, north = bounds
    corners = [pack.georeference.geodetic_from_map((x, y, 0.0)) for x in (west, east) for y in (south, north)]
    lats, lons = [c.lat_deg for c in corners], [c.lon_deg for c in corners]
    found = {"west": min(lons), "south": min(lats), "east": max(lons), "north": max(lats)}
    return {name: round(value, 7) for name, value in found.items()}


def _centre_facts(pack: Pack, middle: tuple[float, float]) -> dict[str, float] | None:
    if pack.georeference.crs is None:
        return None
    place = pack.georeference.geodetic_from_map((*middle, 0.0))
    return {
        "latitude_deg": round(place.lat_deg, 7),
        "longitude_deg": round(place.lon_deg, 7),
        "convergence_deg": round(math.degrees(pack.georeference.convergence_rad(middle)), 6),
        "grid_scale": round(pack.georeference.grid_scale(middle, 0.0), 9),
    }


def _per_km2(size: int, area_km2: float) -> float | None:
    return round(size / 1e6 / area_km2, 4) if area_km2 > 0 else None


# -- rows ----------------------------------------------------------------------------------------------


def _vertical_rows(vertical: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [("heights", " ".join(str(v) for v in (vertical["kind"], vertical["name"]) if v))]
    for name, key in (("to AMSL", "amsl_minus_map_m"), ("to ellipsoid", "ellipsoid_minus_map_m")):
        offset, by_tile = vertical[key], vertical["by_tile"][key]
        text = "not known" if offset is None else f"{offset:+.2f} m"
        if by_tile is not None and by_tile[1] - by_tile[0] >= 0.01:
            text += f", by tile {by_tile[0]:+.2f} to {by_tile[1]:+.2f} m"
        if key == "amsl_minus_map_m" and vertical["amsl_sigma_m"]:
            text += f", 1 sigma {vertical['amsl_sigma_m']:g} m"
        rows.append((f"  {name}", text))
    if vertical["derivation"]:
        rows.append(("  derivation", vertical["derivation"]))
    return rows


def _layer_rows(name: str, layer: dict[str, Any]) -> list[tuple[str, str]]:
    levels = layer["levels_m"]
    rows = [
        (name, f"{layer['gsd_m']:.4g} m/px, {len(levels)} levels to {levels[-1]:.4g} m/px"),
        ("  tiles", f"{layer['tiles']} of up to {layer['tile_px']} px, {layer['tile_m']:.4g} m"),
        ("  data", f"{layer['area_km2']:.4g} km2, {layer['coverage_percent']:.1f} % of the tiles"),
        ("  size", f"{layer['bytes'] / 1e6:.2f} MB, {layer['compression']}"),
    ]
    if name == "DOP":
        rows.append(("  true ortho", {True: "yes", False: "no", None: "not known"}[layer["true_ortho"]]))
        if layer["matchability"] is not None:
            rows.append(("  matchability", f"{100 * layer['matchability']:.0f} of 100 on average"))
    else:
        if layer["height_m"] is not None:
            rows.append(("  heights", f"{layer['height_m'][0]:.2f} to {layer['height_m'][1]:.2f} m"))
        rows.append(("  max z error", f"{layer['max_z_error_m']:g} m by compression"))
        if layer["filled_percent"]:
            rows.append(("  filled", f"{layer['filled_percent']:.2f} %, small holes"))
    rows.append(("  sigma", "not known" if layer["sigma_m"] is None else f"{layer['sigma_m']:g} m"))
    dates = layer["source_dates"]
    if layer["date"]:
        rows.append(("  date", layer["date"]))
    elif dates is not None:
        rows.append(("  date", dates[0] if dates[0] == dates[1] else f"{dates[0]} to {dates[1]}"))
    rows += [(f"  {key}", layer[key]) for key in ("attribution", "licence") if layer[key]]
    names = [source["name"] for source in layer["sources"]]
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    rows.append(("  sources", f"{', '.join(names[:3])}{more}"))
    return rows


def _feature_rows(features: dict[str, Any] | None) -> list[tuple[str, str]]:
    if features is None:
        return [("features", "none")]
    return [
        ("features", f"{features['count']} for {features['matcher']}, {features['encoding']}"),
        ("  size", f"{features['bytes'] / 1e6:.2f} MB, {features['per_mpx']:g} per Mpx of each scale"),
        ("  model", features["model_sha256"]),
    ]
