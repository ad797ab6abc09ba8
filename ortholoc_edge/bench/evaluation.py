"""A sample's matches to its pose, and both to the paper's errors."""

from __future__ import annotations

import numpy as np

from ortholoc_edge.bench import metrics
from ortholoc_edge.bench.ground_truth import true_map_px
from ortholoc_edge.bench.samples import Sample, needed
from ortholoc_edge.matching.types import Matches
from ortholoc_edge.pose import pnp
from ortholoc_edge.pose.lift import lift
from ortholoc_edge.pose.pnp import PoseEstimate
from ortholoc_edge.tiles.window import SurfaceWindow


def localize(sample: Sample, matches: Matches, seed: int = 0) -> PoseEstimate | None:
    """The pose by the sample's surface model and known intrinsics; None if the matches determine none.

    Paper, section "Initial Camera Calibration / Localization": what has no height is left out.
    """
    lifted = lift(matches.map_px, SurfaceWindow(sample.grid, sample.dsm, sample.grid))
    return pnp.solve(
        lifted.points_map,
        matches.query_px[lifted.kept],
        sample.camera,
        max_error_px=pnp.threshold_px(sample.camera),
        seed=seed,
    )


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
    )
