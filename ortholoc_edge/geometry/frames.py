"""The frames that meet in a pose, and the turns between them.

map     easting, northing, height of the pack's projected CRS; grid north.
ned     north, east, down of the local tangent plane; true north.
body    forward, right, down (the autopilot's).
camera  right, down, forward (OpenCV's).
gimbal  forward along the line of sight, right, down: level and toward the nose (or north) when all angles are zero.

``convergence_rad`` is the meridian convergence: the angle from true north to grid north, clockwise positive,
so that ``yaw_grid = yaw_true - convergence`` (PROJ's ``meridian_convergence``).
"""

from __future__ import annotations

import numpy as np

from ortholoc_edge.geometry import rotation
from ortholoc_edge.geometry.arrays import FloatArray

# East, north, up from north, east, down and back: its own inverse.
ENU_FROM_NED: FloatArray = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
ENU_FROM_NED.flags.writeable = False

# A camera that looks straight down with the top of its image toward the nose.
BODY_FROM_NADIR_CAMERA: FloatArray = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
BODY_FROM_NADIR_CAMERA.flags.writeable = False

# A camera that looks along the nose with the top of its image up.
BODY_FROM_FORWARD_CAMERA: FloatArray = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
BODY_FROM_FORWARD_CAMERA.flags.writeable = False

# The mounts that have a name, as ``body_from_camera``. "nadir" looks straight down, and the image's top points to the
# part of the vehicle that is named: of "nadir-right-up" to the right wing.
MOUNTS: dict[str, FloatArray] = {
    "nadir-nose-up": BODY_FROM_NADIR_CAMERA,
    "nadir-right-up": np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]),
    "nadir-tail-up": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "nadir-left-up": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "forward": BODY_FROM_FORWARD_CAMERA,
}
for _mount in MOUNTS.values():
    _mount.flags.writeable = False

# WGS 84 (EPSG:7030).
_SEMI_MAJOR_M = 6378137.0
_ECCENTRICITY_SQUARED = 0.0066943799901413165


def map_from_ned_rotation(convergence_rad: float) -> FloatArray:
    """Rotation taking NED vectors (true north) to map axes (grid east, grid north, up)."""
    return np.asarray(ENU_FROM_NED @ rotation.from_euler(0.0, 0.0, -convergence_rad), dtype=np.float64)


def ecef_from_geodetic(latitude_rad: float, longitude_rad: float, height_ellipsoid_m: float) -> FloatArray:
    """Earth-centred Earth-fixed (3,) metres of a WGS 84 position."""
    sin_lat, cos_lat = np.sin(latitude_rad), np.cos(latitude_rad)
    normal = _SEMI_MAJOR_M / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * sin_lat**2)
    return np.array(
        [
            (normal + height_ellipsoid_m) * cos_lat * np.cos(longitude_rad),
            (normal + height_ellipsoid_m) * cos_lat * np.sin(longitude_rad),
            (normal * (1.0 - _ECCENTRICITY_SQUARED) + height_ellipsoid_m) * sin_lat,
        ]
    )


def ned_from_ecef_rotation(latitude_rad: float, longitude_rad: float) -> FloatArray:
    """Rotation taking ECEF vectors to the tangent plane at a position."""
    sin_lat, cos_lat = np.sin(latitude_rad), np.cos(latitude_rad)
    sin_lon, cos_lon = np.sin(longitude_rad), np.cos(longitude_rad)
    return np.array(
        [
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [-sin_lon, cos_lon, 0.0],
            [-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat],
        ]
    )
