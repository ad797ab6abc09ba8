"""Results on disk and on the screen."""

from __future__ import annotations

import resource
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ortholoc_edge.bench import draw
from ortholoc_edge.bench.flight_log import Comparison
from ortholoc_edge.bench.metrics import Spread, Summary
from ortholoc_edge.bench.replay import FrameResult
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.pipeline.record import outcome_record
from ortholoc_edge.tiles.store import MapStore


def frame_record(result: FrameResult) -> dict[str, Any]:
    """One line of ``frames.jsonl``."""
    return {
        "name": result.name,
        **outcome_record(result.outcome),
        "te_m": result.error and result.error.te_m,
        "re_deg": result.error and result.error.re_deg,
        "nees": result.error and result.error.nees,
        "true_position_map_m": result.truth.translation.tolist(),
        "prior_position_map_m": None if result.prior is None else result.prior.map_from_camera.translation.tolist(),
        "prior_error_m": None
        if result.prior is None
        else float(np.linalg.norm(result.prior.map_from_camera.translation - result.truth.translation)),
        "cpu_ms": result.cpu_ms,
    }


class FrameWriter:
    """Per-frame results under a folder: ``frames.jsonl`` and ``overlays/NAME.png``, written as they come."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        try:
            (folder / "overlays").mkdir(parents=True, exist_ok=True)
            self._lines = (folder / "frames.jsonl").open("wb")
        except OSError as err:
            raise OrtholocError(f"{folder}: can't write results there ({err}); choose another --out") from err

    def write(self, result: FrameResult) -> None:
        try:
            self._lines.write(msgspec.json.encode(frame_record(result)) + b"\n")
            self._lines.flush()
        except OSError as err:
            raise OrtholocError(f"{self._folder}: can't write results ({err})") from err
        if result.image is not None:
            picture = draw.overlay(result.image, result.outcome, result.truth, result.camera, frame_caption(result))
            draw.write_png(self._folder / "overlays" / f"{result.name}.png", picture)

    def close(self) -> None:
        self._lines.close()


def frame_caption(result: FrameResult) -> str:
    outcome, error = result.outcome, result.error
    if isinstance(outcome, Fix) and error is not None:
        return (
            f"{result.name}  TE {error.te_m:.2f} m  RE {error.re_deg:.2f} deg  {outcome.inliers}/{outcome.matches} "
            f"inliers  truth green, estimate red"
        )
    return f"{result.name}  no fix: {getattr(outcome, 'reason', '')}"


def track_picture(store: MapStore, results: list[FrameResult], caption: str) -> np.ndarray:
    """Truth, predictions, fixes and frames without one, over the orthophoto."""
    truth = np.array([r.truth.translation[:2] for r in results])
    priors = [r.prior.map_from_camera.translation[:2] for r in results if r.prior is not None]
    fixes = [r.outcome.map_from_camera.translation[:2] for r in results if isinstance(r.outcome, Fix)]
    missed = [r.truth.translation[:2] for r in results if not isinstance(r.outcome, Fix)]
    return draw.track(
        store,
        [
            draw.Track("truth", truth, draw.TRUTH),
            draw.Track("predicted", np.reshape(priors, (-1, 2)), draw.PRIOR, joined=False),
            draw.Track("fix", np.reshape(fixes, (-1, 2)), draw.ESTIMATE, joined=False),
            draw.Track("no fix (true place)", np.reshape(missed, (-1, 2)), (255, 255, 255), joined=False),
        ],
        caption,
    )


def rss_mb() -> float:
    """Peak resident memory of this process, MiB (Linux counts in KiB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def comparison_table(c: Comparison) -> str:
    """A flight log flown again, for people."""
    rows = [
        ("log", f"{c.files[0]}" + (f" and {len(c.files) - 1} more" if len(c.files) > 1 else "")),
        ("written by", " and ".join([f"ortholoc-edge {c.version}", *map(" ".join, c.other_libraries.items())])),
        ("steps", f"{c.steps}, of which repeated {c.repeated} ({c.alone} from the recorded prediction)"),
        ("fixes", f"{c.fixes} in flight"),
        ("the same", f"{c.same} in every bit"),
    ]
    if c.left_out:
        rows.append(("left out", f"{c.left_out}, the log has no picture without loss of them"))
    if c.same != c.repeated:
        furthest = "" if c.furthest_m is None else f", fixes up to {c.furthest_m:.4f} m apart"
        rows.append(("different", f"{c.repeated - c.same}, {c.other_verdict} of them in the verdict{furthest}"))
        rows.append(("the first", ", ".join(c.differ)))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {text}" for name, text in rows)


def table(summary: Summary) -> str:
    """The summary for people."""

    def spread(s: Spread, unit: str) -> str:
        if s.median is None or s.p90 is None or s.p99 is None or s.max is None:
            return "-"
        return f"median {s.median:.3f}  p90 {s.p90:.3f}  p99 {s.p99:.3f}  max {s.max:.3f} {unit}"

    rows = [
        ("sequence", f"{summary.sequence} on {summary.pack}"),
        (
            "matcher",
            f"{summary.matcher}, AdHoP {'on' if summary.adhop else 'off'}, prior {summary.prior}, "
            f"solver {summary.solver}, seed {summary.seed}",
        ),
        ("model", summary.model_sha256 or "none (no weights)"),
        (
            "frames",
            f"{summary.frames}, of which fixes {summary.fixes} (AdHoP gave the pose of {summary.adhop_accepted})",
        ),
        ("rejected", ", ".join(f"{reason} {count}" for reason, count in summary.rejected.items()) or "none"),
        ("recall", "  ".join(f"{name.replace('_', '-')} {100 * part:.1f} %" for name, part in summary.recall.items())),
        ("position error", spread(summary.te_m, "m")),
        ("rotation error", spread(summary.re_deg, "deg")),
        ("false fixes", str(summary.false_fixes)),
        (
            "NEES",
            "-"
            if summary.nees.mean is None or summary.nees.p95 is None
            else f"mean {summary.nees.mean:.1f}  p95 {summary.nees.p95:.1f}  (honest: mean {summary.nees.dof})",
        ),
    ]
    rows += [
        (f"latency {stage}", f"median {spent.median:.0f}  p95 {spent.p95:.0f}  p99 {spent.p99:.0f} ms")
        for stage, spent in summary.latency_ms.items()
    ]
    rows += [
        ("CPU per frame", f"{summary.cpu_ms_per_frame:.0f} ms"),
        ("peak memory", f"{summary.rss_mb:.0f} MiB"),
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)
