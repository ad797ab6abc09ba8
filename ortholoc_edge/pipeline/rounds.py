"""What the ways of matching a frame with the map have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ortholoc_edge.geometry.arrays import FloatArray
from ortholoc_edge.matching.types import Matches
from ortholoc_edge.pipeline.outcome import Reason
from ortholoc_edge.pose import pnp
from ortholoc_edge.tiles.georeference import LocalFrame
from ortholoc_edge.tiles.window import MapWindow, SurfaceWindow

# Of a first round, to leave other hypotheses untried.
_CONVINCING_INLIERS = 60
_CONVINCING_RATIO = 0.35


class RejectedError(Exception):
    """Carries a rejection out of a stage to `Localizer.localize`, its only catcher."""

    def __init__(self, reason: Reason, detail: str, measured: float | None = None, limit: float | None = None) -> None:
        super().__init__(detail)
        self.reason, self.detail, self.measured, self.limit = reason, detail, measured, limit


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Matches with a height, and the pose that they gave.

    Attributes:
        query_px: (M, 2) frame pixels without distortion; points_map: (M, 3).
        estimate: over these M, in the local frame; None: they determine none.
        matches: how many there were, with or without a height.
    """

    query_px: FloatArray
    points_map: FloatArray
    estimate: pnp.PoseEstimate | None
    matches: int


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """One matching round.

    Attributes:
        matches: frame pixels (undistorted) and pixels of the scene's ``dop_grid``, filtered.
        kept: indices of the matches that have a height.
        points_map: (M, 3) their points.
        estimate: the pose in the local frame, or None.
        mean_error_px: of all M under that pose, each cut at the image's diagonal; infinite without a pose.
    """

    matches: Matches
    kept: np.ndarray
    points_map: FloatArray
    estimate: pnp.PoseEstimate | None
    mean_error_px: float

    @property
    def solved(self) -> Solved:
        return Solved(self.matches.query_px[self.kept], self.points_map, self.estimate, len(self.matches))

    @property
    def inliers(self) -> int:
        return 0 if self.estimate is None else int(np.count_nonzero(self.estimate.inliers))

    @property
    def is_convincing(self) -> bool:
        """Whether other hypotheses need not be tried."""
        return self.inliers >= _CONVINCING_INLIERS and self.inliers >= _CONVINCING_RATIO * len(self.kept)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The part of the map to look at.

    Attributes:
        window: of the map, or of its heights alone.
        local: metric frame of the region.
        ground_m: typical height of the surface in it.
        working_from_dop: (3, 3) from pixels of the window's ``dop_grid`` to where they are predicted in the frame at
            the working size; None where nothing is predicted.
        max_shift_px: how far from there a thing may lie, at the working size.
    """

    window: MapWindow | SurfaceWindow
    local: LocalFrame
    ground_m: float
    working_from_dop: FloatArray | None = None
    max_shift_px: float = math.inf
