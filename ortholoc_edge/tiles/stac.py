"""A pack's tiles as a STAC 1.1 collection, for catalogues: `stac/collection.json` and an item per tile.

Every item has ``datetime`` null and an interval, because a source's date is a day, a month or a year, and a tile may
show several sources. Where the date of one is not known, STAC still demands an interval: the item gets the widest,
which certainly holds the date, with ``ortholoc:date_known`` false, and the collection's is open at both ends.
"""

from __future__ import annotations

import calendar
import json
import re
from collections.abc import Sequence
from datetime import date
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pyproj

from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.tiles.georeference import Georeference, VerticalDatum
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.manifest import Dop, Dsm, DsmTile, Manifest, Tile

FOLDER = "stac"
COLLECTION = f"{FOLDER}/collection.json"

_VERSION = "1.1.0"
_EXTENSIONS = [
    f"https://stac-extensions.github.io/{name}/schema.json"
    for name in ("projection/v2.0.0", "raster/v2.0.0", "file/v2.1.0")
]
_COG = "image/tiff; application=geotiff; profile=cloud-optimized"
_MULTIHASH_SHA256 = "1220"

# From the first photograph taken from the air to the end of what RFC 3339 can write. Not to the pack's creation:
# SOURCE_DATE_EPOCH, where that comes from, may be anything.
_EARLIEST, _LATEST = "1858-01-01T00:00:00Z", "9999-12-31T23:59:59Z"

# STAC names licences as SPDX does; people write those of geodata in many ways.
_SPDX = (
    "CC0-1.0", "CC-BY-3.0", "CC-BY-4.0", "CC-BY-SA-3.0", "CC-BY-SA-4.0", "CC-BY-NC-4.0", "CC-BY-NC-SA-4.0",
    "DL-DE-BY-2.0", "DL-DE-ZERO-2.0", "ODbL-1.0", "ODC-By-1.0", "PDDL-1.0", "OGL-UK-3.0", "etalab-2.0", "NLOD-2.0",
)  # fmt: skip
_NO_SPDX = "other"

# Segments per side of an outline: a side of 4 km bends up to 0.3 m away from the line between its ends, a quarter
# of it 2 cm.
_SEGMENTS = 4
# 1e-7 degrees are 1 cm.
_DIGITS = 7


class _Span(NamedTuple):
    """First and last moment, RFC 3339. ``known``: by the dates of the sources; else the widest that can be."""

    start: str
    end: str
    known: bool


def stac_files(manifest: Manifest, georeference: Georeference) -> dict[str, bytes]:
    """The collection and its items, by path in the pack; nothing for a pack in local metres, which is nowhere.

    Links and assets are relative, so that a pack can be moved. A tile across 180 degrees is cut there, as RFC 7946
    has it; one that holds a pole is not provided for.
    Raises: MapError for a date of a source that is not in the calendar.
    """
    if manifest.crs is None:
        return {}
    system = _system(manifest.crs)
    files: dict[str, bytes] = {}
    rings: list[FloatArray] = []
    spans: list[_Span] = []
    for kind, layer in (("dop", manifest.dop), ("dsm", manifest.dsm)):
        for tile in layer.tiles:
            grid = layer.lattice.grid(tile.box)
            ring, span = _ring(grid.bounds, georeference), _span(layer, tile)
            rings.append(ring)
            spans.append(span)
            name = f"{kind}-{layer.lattice.tile_name(tile.box)}"
            item = {
                "type": "Feature",
                "stac_version": _VERSION,
                "stac_extensions": _EXTENSIONS,
                "id": name,
                "collection": _identity(manifest),
                "geometry": _geometry(ring),
                "bbox": _bbox(ring),
                "properties": _when(span, manifest) | _about([layer]) | {"gsd": layer.gsd_m} | system | _where(grid),
                "links": [_link(rel, "./collection.json") for rel in ("root", "parent", "collection")],
                "assets": _assets(layer, tile, manifest.vertical),
            }
            files[f"{FOLDER}/{name}.json"] = _encoded(item)
    return {COLLECTION: _encoded(_collection(manifest, system, list(files), rings, spans)), **files}


def _collection(
    manifest: Manifest,
    system: dict[str, Any],
    items: Sequence[str],
    rings: Sequence[FloatArray],
    spans: Sequence[_Span],
) -> dict[str, Any]:
    dop, dsm, vertical = manifest.dop, manifest.dsm, manifest.vertical
    dated = all(span.known for span in spans)
    interval = [min(span.start for span in spans), max(span.end for span in spans)] if dated else [None, None]
    summaries: dict[str, list[Any]] = {
        "gsd": sorted({dop.gsd_m, dsm.gsd_m}),
        **{key: [value] for key, value in system.items() if value is not None},
        "ortholoc:vertical_datum": [_vertical_name(vertical)],
    }
    if vertical.epsg is not None:
        summaries["ortholoc:vertical_epsg"] = [vertical.epsg]
    licences = [
        f" Licence of the {name}: {layer.licence}."
        for name, layer in (("orthophoto", dop), ("surface model", dsm))
        if layer.licence
    ]
    links = [_link("root", "./collection.json")]
    links += [_link("item", f"./{path.removeprefix(FOLDER + '/')}", "application/geo+json") for path in items]
    urls = dict.fromkeys(url for layer in (dop, dsm) if (url := _licence_url(layer)))
    links += [_link("license", url, None) for url in urls]
    return {
        "type": "Collection",
        "stac_version": _VERSION,
        "stac_extensions": _EXTENSIONS,
        "id": _identity(manifest),
        "title": "Area pack of OrthoLoC Edge",
        "description": (
            f"Orthophoto of {dop.gsd_m:g} m and surface model of {dsm.gsd_m:g} m per pixel;"
            f" heights: {_vertical_name(vertical)}.{''.join(licences)}"
        ),
        **_about([dop, dsm]),
        "extent": {"spatial": {"bbox": [_bbox(np.concatenate(rings))]}, "temporal": {"interval": [interval]}},
        "summaries": summaries,
        "links": links,
    }


def _assets(layer: Dop | Dsm, tile: Tile, vertical: VerticalDatum) -> dict[str, Any]:
    file = {
        "href": f"../{tile.file}",
        "type": _COG,
        "file:size": tile.bytes,
        "file:checksum": _MULTIHASH_SHA256 + tile.sha256,
    }
    resolution = {"raster:spatial_resolution": layer.gsd_m}
    if isinstance(layer, Dop):
        # No value of a pixel means that there is no data: an internal mask says it.
        bands = [{"name": colour, "data_type": "uint8", **resolution} for colour in ("red", "green", "blue")]
        return {"visual": {**file, "title": "Orthophoto", "roles": ["data", "visual"], "bands": bands}}
    assert isinstance(tile, DsmTile)
    band = {
        "name": "elevation",
        "description": f"Height of the surface: {_vertical_name(vertical)}",
        "data_type": "float32",
        "nodata": layer.nodata,
        "unit": "m",
        "statistics": {"minimum": tile.min_m, "maximum": tile.max_m, "valid_percent": 100 * tile.valid_fraction},
        **resolution,
    }
    return {"elevation": {**file, "title": "Surface model", "roles": ["data"], "bands": [band]}}


def _identity(manifest: Manifest) -> str:
    east, north = (round(value) for value in manifest.anchor)
    return f"ortholoc-pack-{east}_{north}"


def _vertical_name(vertical: VerticalDatum) -> str:
    name = vertical.name or vertical.kind
    return name if vertical.epsg is None else f"{name} (EPSG:{vertical.epsg})"


def _system(crs: str) -> dict[str, Any]:
    if re.fullmatch(r"EPSG:\d+", crs):
        return {"proj:code": crs}
    return {"proj:code": None, "proj:wkt2": pyproj.CRS.from_user_input(crs).to_wkt()}


def _where(grid: RasterGrid) -> dict[str, Any]:
    return {
        "proj:shape": [grid.height, grid.width],
        "proj:bbox": list(grid.bounds),
        "proj:transform": [grid.dx, 0.0, grid.west, 0.0, grid.dy, grid.top],
    }


def _when(span: _Span, manifest: Manifest) -> dict[str, Any]:
    created = {} if manifest.created is None else {"created": manifest.created}
    interval = {"datetime": None, "start_datetime": span.start, "end_datetime": span.end}
    return {**interval, "ortholoc:date_known": span.known, **created}


def _about(layers: Sequence[Dop | Dsm]) -> dict[str, Any]:
    """Licence and whom to credit."""
    licences = {_spdx(layer.licence) for layer in layers}
    about: dict[str, Any] = {"license": licences.pop() if len(licences) == 1 else _NO_SPDX}
    names = dict.fromkeys(layer.attribution for layer in layers if layer.attribution)
    if names:
        about["providers"] = [{"name": name, "roles": ["licensor"]} for name in names]
    return about


def _spdx(licence: str | None) -> str:
    wanted = _plain(licence or "")
    return next((name for name in _SPDX if _plain(name) == wanted), _NO_SPDX)


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())


def _licence_url(layer: Dop | Dsm) -> str | None:
    found = re.search(r"https?://[^\s,;)]+", layer.licence or "")
    return None if found is None else found[0]


def _span(layer: Dop | Dsm, tile: Tile) -> _Span:
    """When the sources of a tile were acquired; of all sources where it does not say which it shows."""
    sources = [layer.sources[index] for index in tile.sources] or layer.sources
    dates = [source.date or layer.date for source in sources] or [layer.date]
    known = [day for day in dates if day is not None]
    if len(known) < len(dates):
        return _Span(_EARLIEST, _LATEST, known=False)
    days = [_days(day) for day in known]
    first, last = min(day[0] for day in days), max(day[1] for day in days)
    return _Span(f"{first.isoformat()}T00:00:00Z", f"{last.isoformat()}T23:59:59Z", known=True)


def _days(text: str) -> tuple[date, date]:
    """First and last day of a date such as 2023, 2023-06 or 2023-06-04."""
    parts = [int(part) for part in text.split("-")]
    first, last = [*parts, 1, 1][:3], [*parts, 12][:2]
    try:
        last = parts if len(parts) == 3 else [*last, calendar.monthrange(*last)[1]]
        return date(*first), date(*last)
    except ValueError as err:
        raise MapError(f"date of acquisition {text}: not in the calendar ({err}); correct it and build again") from err


def _ring(bounds: Bounds, georeference: Georeference) -> FloatArray:
    """Outline of a tile: (N, 2) longitude and latitude, closed, counter-clockwise.

    Longitudes are within 180 degrees of the anchor's, so that none jumps where they end.
    """
    west, south, east, north = bounds
    corners = np.array([[west, south], [east, south], [east, north], [west, north], [west, south]])
    steps = np.arange(_SEGMENTS)[:, None] / _SEGMENTS
    sides = [start + steps * (end - start) for start, end in pairwise(corners)]
    about_lon = georeference.geodetic_from_map((*georeference.anchor, 0.0)).lon_deg
    points = []
    for x, y in np.concatenate([*sides, corners[-1:]]):
        place = georeference.geodetic_from_map((x, y, 0.0))
        points.append((about_lon + (place.lon_deg - about_lon + 180.0) % 360.0 - 180.0, place.lat_deg))
    return np.round(np.array(points), _DIGITS)


def _bbox(ring: FloatArray) -> list[float]:
    """West, south, east, north; west is greater than east where 180 degrees are between."""
    (west, south), (east, north) = ring.min(axis=0), ring.max(axis=0)
    west = (west + 180.0) % 360.0 - 180.0
    east = 180.0 - (180.0 - east) % 360.0
    return [round(float(value), _DIGITS) for value in (west, south, east, north)]


def _geometry(ring: FloatArray) -> dict[str, Any]:
    pieces = []
    for turn in (-360.0, 0.0, 360.0):
        piece = _cut(_cut(ring + np.array([turn, 0.0]), -180.0, 1.0), 180.0, -1.0)
        if len(piece):
            pieces.append([np.round(piece, _DIGITS).tolist()])
    if len(pieces) == 1:
        return {"type": "Polygon", "coordinates": pieces[0]}
    return {"type": "MultiPolygon", "coordinates": pieces}


def _cut(ring: FloatArray, meridian: float, side: float) -> FloatArray:
    """What of a closed ring lies east (``side`` 1) or west (-1) of a meridian: closed, or empty."""
    kept: list[FloatArray] = []
    for start, end in pairwise(ring):
        a, b = (start[0] - meridian) * side, (end[0] - meridian) * side
        if a >= 0:
            kept.append(start)
        if a * b < 0:
            kept.append(start + (end - start) * a / (a - b))
    # Points on the meridian alone are no area.
    if not any((point[0] - meridian) * side > 0 for point in kept):
        return np.empty((0, 2))
    return np.array([*kept, kept[0]])


def _link(rel: str, href: str, kind: str | None = "application/json") -> dict[str, str]:
    return {"rel": rel, "href": href} | ({} if kind is None else {"type": kind})


def _encoded(value: dict[str, Any]) -> bytes:
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False).encode() + b"\n"
