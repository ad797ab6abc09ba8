"""Fixes from the bus as ROS 2 messages: sensor_msgs/NavSatFix and geometry_msgs/PoseWithCovarianceStamped.

Needs no ROS: it makes dicts whose fields are those of the messages, which `rosidl_runtime_py.set_message_fields` takes.
Frames are those of REP 103 and 105: `map` is east, north, up at an origin that you choose, `base_link` is forward,
left, up. What has to be turned, and where mistakes are made:

- our body axes are forward, right, down: half a turn about forward makes them base_link's;
- our quaternions are w, x, y, z; ROS writes x, y, z, w;
- NavSatFix wants the height above the ellipsoid, not above the sea; where the pack does not give it, it is NaN;
- NavSatFix's covariance is east, north, up, 3 x 3 row by row; the pose's is x, y, z, then rotations about the fixed
  axes x, y, z of `map`, 6 x 6 row by row: ours is the same but for the rows' being lists;
- stamps are the exposure's, by the companion computer's date: set it before you rely on them.
"""

from __future__ import annotations

import math
from typing import Any

_COVARIANCE_KNOWN = 3  # NavSatFix.COVARIANCE_TYPE_KNOWN
_S = 1_000_000_000


def nav_sat_fix(fix: dict[str, Any]) -> dict[str, Any]:
    """sensor_msgs/NavSatFix of a message of `…/fix`: the vehicle, or the camera where the body is not known."""
    where = fix["body"] or fix["camera"]
    height_m = where["height_ellipsoid_m"]
    return {
        "header": {"stamp": _stamp(fix["unix_ns"]), "frame_id": "base_link" if fix["body"] else "camera_optical_frame"},
        # No satellites are behind it: STATUS_FIX, and no service.
        "status": {"status": 0, "service": 0},
        "latitude": where["lat_deg"],
        "longitude": where["lon_deg"],
        "altitude": math.nan if height_m is None else height_m,
        "position_covariance": [where["covariance_enu"][row][column] for row in range(3) for column in range(3)],
        "position_covariance_type": _COVARIANCE_KNOWN,
    }


def pose_with_covariance(fix: dict[str, Any], origin: tuple[float, float, float]) -> dict[str, Any] | None:
    """geometry_msgs/PoseWithCovarianceStamped of a message of `…/fix`; None where body or height are not known.

    Args:
        origin: of `map`: latitude and longitude in degrees, height above the ellipsoid in m. Within some kilometres:
            the axes of the fix are taken for the origin's.
    """
    body = fix["body"]
    if body is None or body["height_ellipsoid_m"] is None:
        return None
    east_m, north_m, up_m = _enu((body["lat_deg"], body["lon_deg"], body["height_ellipsoid_m"]), origin)
    w, x, y, z = body["quaternion_enu_wxyz"]
    return {
        "header": {"stamp": _stamp(fix["unix_ns"]), "frame_id": "map"},
        "pose": {
            "pose": {
                "position": {"x": east_m, "y": north_m, "z": up_m},
                # Times (0, 1, 0, 0), half a turn about forward, from the right.
                "orientation": {"x": w, "y": z, "z": -y, "w": -x},
            },
            "covariance": [value for row in body["covariance_enu"] for value in row],
        },
    }


def _stamp(unix_ns: int) -> dict[str, int]:
    return {"sec": unix_ns // _S, "nanosec": unix_ns % _S}


def _enu(place: tuple[float, float, float], origin: tuple[float, float, float]) -> tuple[float, float, float]:
    """East, north, up of a place as seen from the origin, m."""
    there, here = _ecef(*place), _ecef(*origin)
    dx, dy, dz = (there[i] - here[i] for i in range(3))
    lat, lon = math.radians(origin[0]), math.radians(origin[1])
    outward = math.cos(lon) * dx + math.sin(lon) * dy
    return (
        -math.sin(lon) * dx + math.cos(lon) * dy,
        -math.sin(lat) * outward + math.cos(lat) * dz,
        math.cos(lat) * outward + math.sin(lat) * dz,
    )


def _ecef(lat_deg: float, lon_deg: float, height_m: float) -> tuple[float, float, float]:
    """WGS 84."""
    a, f = 6_378_137.0, 1.0 / 298.257223563
    e2 = f * (2.0 - f)
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    n = a / math.sqrt(1.0 - e2 * math.sin(lat) ** 2)
    return (
        (n + height_m) * math.cos(lat) * math.cos(lon),
        (n + height_m) * math.cos(lat) * math.sin(lon),
        (n * (1.0 - e2) + height_m) * math.sin(lat),
    )
