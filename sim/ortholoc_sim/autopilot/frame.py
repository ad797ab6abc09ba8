"""The autopilot's local frame: where it counts from, which it may not know yet, and where that lies."""

from __future__ import annotations

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_sim.site import Earth, Geopoint, Site, geopoint_from_local, local_from_geopoint


class LocalFrame:
    """The filter counts from the site's origin throughout; the others see the EKF origin, which may be another.

    Attributes:
        origin: what GPS_GLOBAL_ORIGIN says; None while there is none.
    """

    def __init__(self, site: Site, known: bool) -> None:
        self._site = site
        self.origin: Geopoint | None = site.origin if known else None

    @property
    def earth(self) -> Earth:
        return self._site.earth

    @property
    def _is_sites(self) -> bool:
        return self.origin is None or self.origin == self._site.origin

    def public_from_inner(self, position_ned_m: FloatArray) -> FloatArray:
        """(3,) from the EKF origin; the filter's own where there is none."""
        if self._is_sites:
            return position_ned_m
        assert self.origin is not None
        return local_from_geopoint(self.earth, self.origin, self.geopoint(position_ned_m))

    def inner_from_public(self, position_ned_m: FloatArray) -> FloatArray:
        """Inverse of :meth:`public_from_inner`. What is not finite stays so."""
        if self._is_sites or not np.isfinite(position_ned_m).all():
            return position_ned_m
        assert self.origin is not None
        return self.inner(geopoint_from_local(self.earth, self.origin, position_ned_m))

    def inner(self, point: Geopoint) -> FloatArray:
        """(3,) the filter's position of a place."""
        return self._site.autopilot_from_geopoint(point)

    def geopoint(self, position_ned_m: FloatArray) -> Geopoint:
        """The place of a position of the filter."""
        return self._site.geopoint_from_autopilot(position_ned_m)
