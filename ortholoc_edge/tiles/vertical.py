"""What a pack's heights are measured from, found when it is built, and the offsets to the heights that others mean.

PROJ, asked for a vertical transformation whose geoid grid is not installed, answers with the unchanged height. So the
offsets are derived here once, from an operation that demonstrably used a grid, or from a figure that the user stated.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import numpy.typing as npt

from ortholoc_edge.errors import ConfigError, MapError
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.tiles.georeference import VerticalDatum, VerticalKind
from ortholoc_edge.tiles.systems import operations, parsed_crs

logger = logging.getLogger(__name__)

# Geoid undulations on Earth lie within -107 to +86 m (EGM96).
_MAX_UNDULATION_M = 120.0

# National zero levels lie within about 2 m of EGM96's; a stated undulation further off than this from PROJ's
# is a wrong sign or a wrong place.
_MAX_UNDULATION_DISAGREEMENT_M = 3.0

_EGM96_EPSG = 5773
_NAVD88_EPSG = 5703

# 1 sigma of the way from a map height to EGM96's: by a grid (interpolation, slope of the geoid over the area), or
# by taking another sea level for it.
_GRID_SIGMA_M = 0.1
_ZERO_LEVEL_SIGMA_M = 1.0
_NAVD88_SIGMA_M = 2.0


def vertical_of(crs: str, what: str) -> tuple[VerticalKind, int | None] | None:
    """Kind and EPSG code of the heights that a compound or 3D system names; None if it names none."""
    parsed = parsed_crs(crs, what)
    if parsed.is_compound and len(parsed.sub_crs_list) > 1:
        vertical = parsed.sub_crs_list[1]
        _require_metre_heights(vertical.axis_info[0], vertical.name, what)
        ellipsoidal = "ellipsoid" in vertical.axis_info[0].name.lower()
        return ("ellipsoid", None) if ellipsoidal else ("orthometric", vertical.to_epsg())
    if len(parsed.axis_info) == 3:
        _require_metre_heights(parsed.axis_info[2], parsed.name, what)
        return ("ellipsoid", None)
    return None


def derive_offsets(
    kind: VerticalKind,
    epsg: int | None,
    geoid_undulation_m: float | None,
    lat_lon_deg: npt.ArrayLike | None,
    *,
    quiet: bool = False,
) -> tuple[VerticalDatum, FloatArray | None, FloatArray | None]:
    """Vertical datum with its two offsets, over an area.

    Offsets come from PROJ where it has the geoid grid for all of the area, else from the undulation that the user
    stated. Heights above a sea level whose grid is missing are taken as AMSL, with a warning: the national zeros
    lie within 0.2-1 m of EGM96's (NAVD88: 1-2 m); the derivation says so and ``amsl_sigma_m`` has the figure.
    Args:
        geoid_undulation_m: height of the geoid above the ellipsoid in the area, m.
        lat_lon_deg: (N, 2) places, the anchor first; None for a local frame, where PROJ cannot help.
        quiet: without the warning, where it was given before.
    Returns: the datum with the offsets at the first place; (N,) ``amsl_minus_map_m`` at the places; (N,)
        ``ellipsoid_minus_map_m``. The arrays are None where the datum's value is, and for a local frame.
    Raises: ConfigError for values that contradict each other, and for heights above the ellipsoid whose geoid
        neither PROJ nor the user knows; MapError for an EPSG code that is no vertical system in metres.
    """
    if kind == "unknown":
        if geoid_undulation_m is not None or epsg is not None:
            raise ConfigError(
                "--geoid-undulation-m and --vertical-epsg say nothing without the kind of heights; add"
                " --vertical ellipsoid or --vertical orthometric"
            )
        return VerticalDatum(kind="unknown", derivation="stated as unknown when the pack was built"), None, None
    if geoid_undulation_m is not None and not abs(geoid_undulation_m) <= _MAX_UNDULATION_M:
        raise ConfigError(
            f"--geoid-undulation-m {geoid_undulation_m}: beyond +-{_MAX_UNDULATION_M:.0f} m, where no geoid is;"
            " state the height of the geoid above the ellipsoid in metres"
        )
    places = None if lat_lon_deg is None else np.asarray(lat_lon_deg, dtype=np.float64).reshape(-1, 2)
    amsl_minus_ellipsoid = _grid_offsets("EPSG:4979", f"EPSG:4326+{_EGM96_EPSG}", places)
    if kind == "ellipsoid":
        return _of_ellipsoid(epsg, geoid_undulation_m, amsl_minus_ellipsoid, places)
    found = _of_sea_level(epsg, geoid_undulation_m, amsl_minus_ellipsoid, places)
    datum = found[0]
    if not quiet and datum.amsl_sigma_m is not None and datum.amsl_sigma_m >= _ZERO_LEVEL_SIGMA_M:
        logger.warning(
            "%s: PROJ has no geoid grid that leads to EGM96, so heights are taken as AMSL, good to %g m (1 sigma)",
            datum.name or "heights above a sea level that is not named", datum.amsl_sigma_m,
        )  # fmt: skip
    return found


def _of_ellipsoid(
    epsg: int | None, stated_m: float | None, amsl_minus_ellipsoid: FloatArray | None, places: FloatArray | None
) -> tuple[VerticalDatum, FloatArray | None, FloatArray | None]:
    if epsg is not None:
        raise ConfigError("--vertical-epsg names a sea level; it goes with --vertical orthometric")
    _check_undulation(stated_m, amsl_minus_ellipsoid)
    if amsl_minus_ellipsoid is not None:
        amsl_m, sigma_m, derivation = float(amsl_minus_ellipsoid[0]), _GRID_SIGMA_M, "geoid EGM96 through PROJ"
    elif stated_m is not None:
        amsl_m, sigma_m = -stated_m, 0.0
        derivation = f"geoid {stated_m:+.2f} m above the ellipsoid, as stated"
        amsl_minus_ellipsoid = _everywhere(amsl_m, places)
    else:
        raise ConfigError(
            "heights are above the ellipsoid, and the geoid there is not known: state it with --geoid-undulation-m"
            " METRES (geoid above ellipsoid), or give PROJ its grid: us_nga_egm96_15.tif in the folder PROJ_DATA,"
            " or projsync --file us_nga_egm96_15.tif"
        )
    datum = VerticalDatum(
        kind="ellipsoid",
        name="WGS 84 ellipsoid",
        amsl_minus_map_m=amsl_m,
        ellipsoid_minus_map_m=0.0,
        derivation=derivation,
        amsl_sigma_m=sigma_m,
    )
    return datum, amsl_minus_ellipsoid, _everywhere(0.0, places)


def _of_sea_level(
    epsg: int | None, stated_m: float | None, amsl_minus_ellipsoid: FloatArray | None, places: FloatArray | None
) -> tuple[VerticalDatum, FloatArray | None, FloatArray | None]:
    name = None if epsg is None else _vertical_name(epsg)
    ellipsoid = None if epsg is None else _grid_offsets(f"EPSG:4326+{epsg}", "EPSG:4979", places)
    amsl: FloatArray | None
    if ellipsoid is not None:
        _check_undulation(stated_m, -ellipsoid)
    if ellipsoid is not None and amsl_minus_ellipsoid is not None:
        amsl, derivation = ellipsoid + amsl_minus_ellipsoid, f"{name} and EGM96 through PROJ"
        sigma_m = 0.0 if epsg == _EGM96_EPSG else _GRID_SIGMA_M
    elif epsg == _EGM96_EPSG:
        amsl, sigma_m, derivation = _everywhere(0.0, places), 0.0, "heights are EGM96's own"
    else:
        amsl = _everywhere(0.0, places)
        derivation = "its zero taken as EGM96's, which is true to about 1 m (NAVD88: 2 m)"
        sigma_m = _NAVD88_SIGMA_M if epsg == _NAVD88_EPSG else _ZERO_LEVEL_SIGMA_M
    ellipsoid_m = None if ellipsoid is None else float(ellipsoid[0])
    if ellipsoid is None and stated_m is not None:
        ellipsoid_m, ellipsoid = stated_m, _everywhere(stated_m, places)
        derivation += f"; geoid {stated_m:+.2f} m above the ellipsoid, as stated"
    datum = VerticalDatum(
        kind="orthometric",
        name=name,
        epsg=epsg,
        amsl_minus_map_m=0.0 if amsl is None else float(amsl[0]),
        ellipsoid_minus_map_m=ellipsoid_m,
        derivation=derivation,
        amsl_sigma_m=sigma_m,
    )
    return datum, amsl, ellipsoid


def _everywhere(offset_m: float, places: FloatArray | None) -> FloatArray | None:
    return None if places is None else np.full(len(places), offset_m)


def _grid_offsets(source: str, target: str, places: FloatArray | None) -> FloatArray | None:
    """Target height minus source height, m, at places (N, 2) as latitude and longitude, by one operation that uses a
    grid; None if PROJ has none that covers them all.

    PROJ falls back to leaving the height alone, and tells only in the operation's metadata; hence the choice
    by grids here instead of taking what `Transformer.from_crs` gives.
    """
    if places is None:
        return None
    lat, lon = places.T
    group = operations(source, target, lon, lat)
    for transformer in group.transformers:
        steps = transformer.operations or ()
        grids = [grid for operation in steps for grid in operation.grids]
        if not grids or not all(grid.available for grid in grids):
            continue
        heights = np.asarray(transformer.transform(lon, lat, np.zeros(len(lon)))[2], dtype=np.float64)
        if np.isfinite(heights).all():
            return heights
    return None


def _check_undulation(stated_m: float | None, amsl_minus_ellipsoid: FloatArray | None) -> None:
    """At the first place: over a large area the geoid itself may move by more than the tolerance."""
    if stated_m is None or amsl_minus_ellipsoid is None:
        return
    found_m = -float(amsl_minus_ellipsoid[0])
    if abs(stated_m - found_m) > _MAX_UNDULATION_DISAGREEMENT_M:
        raise ConfigError(
            f"--geoid-undulation-m {stated_m:+.2f}: PROJ's geoid lies {found_m:+.2f} m above"
            " the ellipsoid here; correct the value (the sign is geoid above ellipsoid) or leave it out"
        )


def _vertical_name(epsg: int) -> str:
    crs = parsed_crs(f"EPSG:{epsg}", f"--vertical-epsg {epsg}")
    if not crs.is_vertical:
        raise MapError(f"--vertical-epsg {epsg}: {crs.name} is no vertical system; name one such as 5773 or 7837")
    _require_metre_heights(crs.axis_info[0], crs.name, f"--vertical-epsg {epsg}")
    return str(crs.name)


def _require_metre_heights(axis: Any, name: str, what: str) -> None:
    if abs(axis.unit_conversion_factor - 1.0) > 1e-12 or axis.direction != "up":
        raise MapError(
            f"{what}: heights of {name} are in {axis.unit_name}, {axis.direction}; convert them to metres, up"
            " (gdal_calc.py) and name the metric vertical system"
        )
