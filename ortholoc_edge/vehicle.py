"""The autopilot as the pipeline sees it: the vehicle's state in the map's terms, and fixes in the autopilot's."""

from __future__ import annotations

import logging
import math
import threading
from collections import Counter

import numpy as np

from ortholoc_edge.adapters.mavlink import AutopilotLink, AutopilotState, GnssPosition
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.geodesy import (
    EarthModel,
    GeodeticOrigin,
    Place,
    geodetic_from_ned,
    is_same_origin,
    ned_from_geodetic,
)
from ortholoc_edge.adapters.mavlink.sinks import earth_model
from ortholoc_edge.clock import Clock
from ortholoc_edge.config import AttitudeOptions, MountOptions
from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry import covariance as cov
from ortholoc_edge.geometry import frames
from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import TURN_AGES_NS, CameraMount, VehicleState
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.tracker import Tracker
from ortholoc_edge.tiles.georeference import Georeference

logger = logging.getLogger(__name__)

# From its origin; beyond, its filter has diverged.
_FARTHEST_M = 100_000.0
# The autopilot's attitude for an exposure arrives after it; the frame waits this long for it at most.
STATE_WAIT_NS = 150_000_000


class Vehicle:
    """States at exposures in, estimates out. Used by one thread.

    Counts are added to those of the owner: ``gnss_unusable``, ``no_autopilot``, ``no_origin``.

    Attributes:
        no_origin_ns: when a fix was found last that the autopilot had no origin for; None: never.
    """

    def __init__(
        self,
        link: AutopilotLink,
        tracker: Tracker,
        georeference: Georeference,
        mount: MountOptions,
        attitude: AttitudeOptions,
        clock: Clock,
        counts: Counter[str],
    ) -> None:
        self._link, self._tracker, self._georeference = link, tracker, georeference
        self._mount, self._attitude = mount, attitude
        self._clock, self._counts = clock, counts
        self._origin: GeodeticOrigin | None = None
        self._restarts = 0
        self.no_origin_ns: int | None = None

    def retune(self, attitude: AttitudeOptions) -> None:
        """Take the autopilot's attitude for as good as that from now on."""
        self._attitude = attitude

    # -- in ---------------------------------------------------------------------------------------------

    def at(self, stamp_ns: int, stop: threading.Event) -> VehicleState:
        """The vehicle's state at an exposure, waiting a little for the telemetry that follows it."""
        deadline_ns = self._clock.now_ns() + STATE_WAIT_NS
        while True:
            known = self._link.state_at(stamp_ns)
            is_final = known is not None and known.interpolated
            if is_final or self._clock.now_ns() >= deadline_ns or stop.wait(0.005):
                return self._in_the_map(stamp_ns, known)

    def _in_the_map(self, stamp_ns: int, known: AutopilotState | None) -> VehicleState:
        roll, pitch, yaw = (math.radians(sigma) for sigma in self._attitude.sigma_deg)
        trouble = self._link.trouble() if known is None or known.ned_from_body is None else None
        if known is None:
            return VehicleState(stamp_ns, None, (roll, pitch, yaw), no_attitude_because=trouble or "")
        position = None if known.gnss is None else self._map_position(known.gnss)
        return VehicleState(
            stamp_ns,
            known.ned_from_body,
            (roll, pitch, yaw),
            known.odometry_ned_m,
            known.odometry_epoch,
            position,
            (0.0, 0.0) if known.gnss is None else (known.gnss.sigma_horizontal_m, known.gnss.sigma_vertical_m),
            self._gimbal_mount(known),
            trouble or "",
            self._believed_position(known),
            known.velocity_ned,
            known.turning_rad_s,
            self._link.turns_before(stamp_ns, TURN_AGES_NS),
        )

    def _believed_position(self, known: AutopilotState) -> FloatArray | None:
        """Of its filter, in the map; None where it tells none, or none that can be."""
        vehicle = self._link.vehicle
        position, origin = known.local_position_ned_m, known.origin
        if vehicle is None or position is None or origin is None or not np.isfinite(position).all():
            return None
        if float(np.abs(position).max()) > _FARTHEST_M:
            return None
        place = geodetic_from_ned(origin, position, earth_model(vehicle.autopilot))
        try:
            return self._georeference.map_from_geodetic(place[0], place[1], height_amsl_m=place[2])
        except MapError:
            return None

    def _gimbal_mount(self, known: AutopilotState) -> CameraMount | None:
        if known.ned_from_gimbal is None or known.ned_from_body is None:
            return None
        tilt, heading = (
            math.hypot(math.radians(sigma_deg), known.gimbal_sigma_rad) for sigma_deg in self._mount.gimbal_sigma_deg
        )
        return CameraMount(
            self._mount.body_from_camera_in(known.ned_from_body.T @ known.ned_from_gimbal), (tilt, heading)
        )

    def _map_position(self, gnss: GnssPosition) -> FloatArray | None:
        """None for a place that the pack's projection can't take, a spoofed one on another continent, say."""
        try:
            return self._georeference.map_from_geodetic(
                gnss.latitude_deg, gnss.longitude_deg, height_amsl_m=gnss.height_amsl_m
            )
        except MapError as error:
            if not self._counts["gnss_unusable"]:
                logger.warning("the autopilot's GNSS position can't be used: %s", error)
            self._counts["gnss_unusable"] += 1
            return None

    # -- out --------------------------------------------------------------------------------------------

    def tell(self, fix: Fix, state: VehicleState) -> None:
        """Hand a fix to the link, where the autopilot can make something of it.

        Args:
            state: of its exposure, from :meth:`at`.
        """
        vehicle, now = self._link.vehicle, self._link.state_at(fix.stamp_ns)
        mount = self._tracker.mount(state)
        if now is None or vehicle is None or mount is None:
            self._counts["no_autopilot"] += 1
            return
        map_from_body = fix.map_from_camera @ mount.body_from_camera.inverse()
        local = [sink.local for sink in self._link.sinks]
        if now.origin is None and any(local):
            self._counts["no_origin"] += 1
            self.no_origin_ns = self._clock.now_ns()
            self._offer_origin(map_from_body.translation)
            if all(local):
                return
        self._announce_jump(now.origin, any(local))
        estimate = vision_estimate(
            fix,
            map_from_body,
            self._georeference,
            now.origin,
            earth_model(vehicle.autopilot),
            self._tracker.reset_counter,
            mount.sigma_rad,
        )
        self._link.send_estimate(estimate)

    def _announce_jump(self, origin: GeodeticOrigin | None, is_local: bool) -> None:
        """Where what was sent before meant other places, or is forgotten: without notice the filter would take the next
        estimate for a jump."""
        moved = is_local and not (self._origin is None or origin is None or is_same_origin(origin, self._origin))
        restarts = self._link.restarts
        if moved or restarts != self._restarts:
            why = "moved its origin" if moved else "restarted"
            logger.warning("the autopilot %s; its filter is told to start anew", why)
            self._tracker.announce_jump()
        self._restarts = restarts
        self._origin = origin or self._origin

    def _offer_origin(self, position_map: FloatArray) -> None:
        place = self._georeference.geodetic_from_map(position_map)
        if place.height_amsl_m is not None:
            self._link.offer_origin(GeodeticOrigin(place.lat_deg, place.lon_deg, place.height_amsl_m))


def vision_estimate(
    fix: Fix,
    map_from_body: Rigid3,
    georeference: Georeference,
    origin: GeodeticOrigin | None,
    model: EarthModel,
    reset_counter: int,
    mount_sigma_rad: tuple[float, float] = (0.0, 0.0),
) -> VisionEstimate:
    """A fix as the autopilot wants it: the body on WGS 84 and in the autopilot's local NED, true north.

    Args:
        map_from_body: of the fix.
        origin: the autopilot's; without one the estimate has no local position.
        model: by which the autopilot itself relates its local frame to latitude and longitude.
        mount_sigma_rad: `CameraMount.sigma_rad`: the fix is of the camera, and the body is seen through the gimbal.
    Raises: MapError if the pack does not say how its heights relate to AMSL.
    """
    place = georeference.geodetic_from_map(map_from_body.translation)
    if place.height_amsl_m is None:
        raise MapError("the pack's heights can't be turned into AMSL; rebuild it with --geoid-undulation-m")
    ned_from_map = frames.map_from_ned_rotation(georeference.convergence_rad(map_from_body.translation[:2])).T
    lever = map_from_body.translation - fix.map_from_camera.translation
    covariance = cov.rotated(cov.of_moved_point(fix.covariance, lever), ned_from_map)
    covariance[3:, 3:] += cov.turn(mount_sigma_rad)
    # Common to the whole pack: no match tells of it, so it joins only where the height leaves the pack's datum.
    covariance[2, 2] += (georeference.vertical.amsl_sigma_m or 0.0) ** 2
    position = None
    if origin is not None:
        position = ned_from_geodetic(origin, place.lat_deg, place.lon_deg, place.height_amsl_m, model)
    return VisionEstimate(
        fix.stamp_ns,
        position,
        ned_from_map @ map_from_body.rotation,
        covariance,
        reset_counter,
        min(fix.quality, 1.0),
        Place(place.lat_deg, place.lon_deg, place.height_amsl_m, place.height_ellipsoid_m),
        origin,
    )
