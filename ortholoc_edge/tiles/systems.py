"""Reference systems as a build needs them: through pyproj, which knows the ways between two and what they lack.

What flies does without pyproj (see `georeference`): it would take 15 MB, with a PROJ of its own beside rasterio's.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
from pyproj import CRS, Transformer
from pyproj.aoi import AreaOfInterest
from pyproj.exceptions import CRSError, ProjError
from pyproj.network import set_network_enabled  # type: ignore[attr-defined]  # documented, not in __all__
from pyproj.transformer import TransformerGroup

from ortholoc_edge.errors import MapError
from ortholoc_edge.tiles.georeference import horizontal_part, utm_code

_AREA_MARGIN_DEG = 0.5


def parsed_crs(crs: str, what: str) -> CRS:
    """Anything PROJ reads. Raises: MapError that starts with ``what``."""
    try:
        return CRS.from_user_input(crs)
    except CRSError as err:
        raise MapError(f"{what}: reference system not understood ({err}); name it as EPSG:n or WKT") from err


def projected_crs(crs: str, what: str) -> CRS:
    """The horizontal part of a projected reference system in metres.

    Args:
        crs: anything PROJ reads; the height axis of a compound system is dropped (see `vertical.vertical_of`).
        what: what has this system, to start the message with.
    Raises: MapError with the remedy if it is unreadable, geographic, not projected or not in metres.
    """
    parsed = parsed_crs(crs, what)
    horizontal_part(parsed.to_json_dict(), what)
    parsed = parsed.sub_crs_list[0] if parsed.is_compound else parsed
    parsed = parsed.source_crs if parsed.is_bound and parsed.source_crs is not None else parsed
    return parsed.to_2d()


def require_way_to_wgs84(crs: str, lat_lon_deg: tuple[float, float]) -> None:
    """Refuse a system whose datum PROJ cannot bring to WGS 84 at a place.

    In flight it would be taken for WGS 84: hundreds of metres off, and GDAL does not tell.
    Raises: MapError with the remedy.
    """
    lat, lon = lat_lon_deg
    system = projected_crs(crs, crs)
    try:
        Transformer.from_crs(
            system, "EPSG:4326", always_xy=True, area_of_interest=_area(lon, lat), allow_ballpark=False
        )
    except ProjError as err:
        raise MapError(
            f"{system.name}: PROJ knows no way to WGS 84 at {lat:.3f}, {lon:.3f} ({err});"
            f" reproject the rasters with: gdalwarp -t_srs {utm_code(lat, lon)}"
        ) from err


def datum_shift_caveat(crs: str, lat_lon_deg: tuple[float, float]) -> str | None:
    """What PROJ lacks for the best way from ``crs`` to WGS 84 at a place; None if nothing.

    Without its grid an old national datum (DHDN, NAD27) is shifted by a few parameters, metres off.
    """
    lat, lon = lat_lon_deg
    group = operations(projected_crs(crs, crs), "EPSG:4326", lon, lat)
    if group.best_available or not group.unavailable_operations:
        return None
    grids = [grid.short_name for grid in group.unavailable_operations[0].grids if not grid.available]
    accuracies = [one.accuracy for one in group.transformers if one.accuracy >= 0]
    good_to = f"to about {min(accuracies):g} m" if accuracies else "to nobody knows what"
    return f"PROJ lacks {', '.join(grids)}: latitudes and longitudes are good {good_to}"


def operations(source: CRS | str, target: str, lon: npt.ArrayLike, lat: npt.ArrayLike) -> TransformerGroup:
    """PROJ's ways between two systems over some places, best first, without those that pretend."""
    # A grid fetched from the network today would be missing on the next build; the pack would differ.
    set_network_enabled(active=False)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Best transformation is not available")
        return TransformerGroup(source, target, always_xy=True, area_of_interest=_area(lon, lat), allow_ballpark=False)


def _area(lon: npt.ArrayLike, lat: npt.ArrayLike) -> Any:
    lon, lat = np.asarray(lon), np.asarray(lat)
    return AreaOfInterest(
        max(float(lon.min()) - _AREA_MARGIN_DEG, -180.0),
        max(float(lat.min()) - _AREA_MARGIN_DEG, -90.0),
        min(float(lon.max()) + _AREA_MARGIN_DEG, 180.0),
        min(float(lat.max()) + _AREA_MARGIN_DEG, 90.0),
    )
