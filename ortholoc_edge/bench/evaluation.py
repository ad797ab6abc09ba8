"""A sample's matches to its pose, and both to the paper's errors."""

from __future__ import annotations

import numpy as np

from ortholoc_edge.bench import metrics
from ortholoc_edge.bench.ground_truth import true_map_px
from ortholoc_edge.bench.samples import Sample, needed
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.matching.types import Matches
from ortholoc_edge.pipeline.calibration import refusal
from ortholoc_edge.pipeline.gate import GateOptions
from ortholoc_edge.pose import calibrate, pnp
from ortholoc_edge.pose.calibrate import Unknowns, View
from ortholoc_edge.pose.lift import Lifted, lift
from ortholoc_edge.pose.pnp import PoseEstimate
from ortholoc_edge.tiles.window import SurfaceWindow

# The paper holds the principal point in the middle of the image.
_ONLY_FOCAL = Unknowns(principal_point_sigma=0.0)


def localize(sample: Sample, matches: Matches, seed: int = 0, surface: Sample | None = None) -> PoseEstimate | None:
    """The pose by known intrinsics; None if the matches determine none.

    Paper, section "Initial Camera Calibration / Localization": what has no height is left out.

    Args:
        matches: of the sample's photo with pixels of its grid.
        surface: whose surface model gives the heights, in the same frame; None: the sample's.
    """
    lifted = _lifted(sample, matches, surface)
    return pnp.solve(
        lifted.points_map,
        matches.query_px[lifted.kept],
        sample.camera,
        max_error_px=pnp.threshold_px(sample.camera),
        seed=seed,
    )


def calibrate_focal(
    sample: Sample, matches: Matches, seed: int = 0, surface: Sample | None = None
) -> tuple[PoseEstimate | None, bool]:
    """As `localize`, with an unknown focal length, from the paper's start: the long side of the photo.

    Returns: what came out, and whether `calibrate-focal` would call it a calibration.
    """
    lifted = _lifted(sample, matches, surface)
    width, height = sample.camera.width, sample.camera.height
    start = Camera.from_focal(width, height, float(max(width, height)))
    view = View(lifted.points_map, matches.query_px[lifted.kept])
    found = calibrate.solve([view], start, _ONLY_FOCAL, seed=seed)
    if found is None:
        return None, False
    (estimate,) = found.views
    return estimate, refusal(view, estimate, start, GateOptions()) is None and calibrate.ill_posed(found) is None


def _lifted(sample: Sample, matches: Matches, surface: Sample | None) -> Lifted:
    below = surface or sample
    return lift(matches.map_px, SurfaceWindow(sample.grid, below.dsm, below.grid))


def sample_error(sample: Sample, matches: Matches, estimate: PoseEstimate | None) -> metrics.SampleError:
    """Errors of matches and of the pose that was made of them.

    Raises: DatasetError for a sample without point map or keypoints.
    """
    matching = metrics.matching_errors_px(matches.map_px, true_map_px(sample, matches.query_px))
    me_px = metrics.median_error(matching)
    if estimate is None:
        return metrics.SampleError(me_px, np.inf, np.inf, np.inf)
    # A sample's frame is the solver's: metres, of a scale of 1.
    pose, truth = estimate.local_from_camera, sample.map_from_camera
    keypoints = needed(sample.keypoints, sample, "keypoints")
    reprojection = metrics.reprojection_errors_px(keypoints, pose, truth, sample.camera, estimate.camera)
    return metrics.SampleError(
        me_px,
        metrics.translation_error_m(pose, truth),
        metrics.rotation_error_deg(pose, truth),
        metrics.median_error(reprojection),
        None
        if estimate.focal_sigma_px is None
        else metrics.relative_focal_error(estimate.camera, sample.camera),
    )
