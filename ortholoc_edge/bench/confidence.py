"""How good a pose the map allows: ground-truth matches, less and less of them by their confidence.

Paper, appendix "Are 2.5D Rasters Sufficient for Accurate Localization?".
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from ortholoc_edge.bench.evaluation import localize, sample_error
from ortholoc_edge.bench.ground_truth import GroundTruthMatcher
from ortholoc_edge.bench.metrics import SampleError, SampleSummary
from ortholoc_edge.bench.samples import Sample

# The paper's.
THRESHOLDS = (0.0, 0.5, 0.95, 0.99)


class ConfidenceErrors(Struct, frozen=True):
    """One sample with the matches above one threshold.

    ``kept``: part of the sample's ground-truth matches.
    """

    above: float
    kept: float
    error: SampleError


class ConfidenceRow(Struct, frozen=True):
    """All samples with the matches above one threshold; ``kept``: the mean part of a sample's matches."""

    above: float
    kept: float
    errors: SampleSummary


def confidence_errors(
    sample: Sample, matcher: GroundTruthMatcher, thresholds: Sequence[float] = THRESHOLDS, seed: int = 0
) -> list[ConfidenceErrors]:
    """One sample, threshold by threshold. Raises: DatasetError for one without point map or keypoints."""
    matches = matcher.match(sample)
    confidence = np.zeros(0) if matches.confidence is None else matches.confidence
    found = []
    for above in thresholds:
        confident = matches.take(np.flatnonzero(confidence > above))
        error = sample_error(sample, confident, localize(sample, confident, seed))
        found.append(ConfidenceErrors(above, len(confident) / max(len(matches), 1), error))
    return found


def confidence_rows(samples: Sequence[Sequence[ConfidenceErrors]]) -> list[ConfidenceRow]:
    """The table's rows of what `confidence_errors` found, all by the same thresholds."""
    return [
        ConfidenceRow(
            same[0].above, float(np.mean([one.kept for one in same])), SampleSummary.of([one.error for one in same])
        )
        for same in zip(*samples, strict=True)
    ]
