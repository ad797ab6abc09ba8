"""What ``bench-core`` prints: Markdown sections for docs/benchmarks.md, or a JSON object per row."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

import msgspec
import numpy as np

from ortholoc_edge.bench import core, hostile
from ortholoc_edge.bench.core import Comparison, Figures, Take, Target
from ortholoc_edge.bench.hostile import Verdict
from ortholoc_edge.bench.report import frame_record
from ortholoc_edge.cli.measured import print_heading, provenance

FIGURES: Final = (
    "| set | matcher | query px | frames | recall 1m-1° | 0.5m-0.5° | TE median / p90 / max m | RE median ° "
    "| false fixes | NEES mean / dof | NEES p95 | beyond protection | CPU median / p99 ms | wall median / p99 ms "
    "| wall p99 / median |"
)
HOSTILE: Final = "| kind | matcher | frames | false fixes | right all the same | rejected |"
_COMPARISON: Final = (
    "| the paper's with | ours | frames | both gave a pose | their median TE / ours | their median CPU / ours |"
)
_TARGETS: Final = "| target of issue 4 | on | limit | measured | met |"
# Of the missed frames, so many in the Markdown.
_NAMED = 12
_FALSE_FIXES: Final = "| trial | kind | map | frame | shown | matcher | TE m | RE ° | inliers / matches | rms px |"


class Report:
    """Rows as they come; the targets of a section after its table."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._is_begun = False
        self._targets: list[tuple[str, Target]] = []

    def section(self, title: str, text: str, columns: str) -> None:
        if self._as_json:
            return
        if not self._is_begun:
            # Wall times, and by the caches CPU times too, are worth little on a busy machine.
            print(f"{provenance()}, load {os.getloadavg()[0]:.1f} when it began\n")
            self._is_begun = True
        print(f"### {title}\n\n{text}\n")
        print_heading(columns)

    def figures(self, found: Figures, *, is_judged: bool = False) -> None:
        """A row. ``is_judged``: the targets are about it."""
        self._row("figures", msgspec.to_builtins(found), _figures_row(found))
        if is_judged:
            self._targets += [(f"{found.name} {found.matcher}", target) for target in core.targets(found)]

    def missed(self, takes: Sequence[Take]) -> None:
        """Frames beyond 1m-1°, each with the number of its prior (in tracking: the seed)."""
        found = [take for take in takes if take.is_missed]
        if self._as_json:
            for take in found:
                record = {**frame_record(take.result), "set": take.scene.site.name, "draw": take.draw}
                self._row("missed", record, "")
        elif found:
            named = [f"{take.scene.site.name}/{take.result.name} #{take.draw} {_how(take)}" for take in found[:_NAMED]]
            more = f", and {len(found) - _NAMED} more (--json names all)" if len(found) > _NAMED else ""
            print(f"\nBeyond 1m-1° ({len(found)}): {', '.join(named)}{more}.", flush=True)

    def counts(self, kind: str, matcher: str, verdicts: Sequence[Verdict], *, is_judged: bool = False) -> None:
        """A row about one kind of hostile frames; none where there were none."""
        if not verdicts:
            return
        outcomes = Counter(v.outcome for v in verdicts)
        false, right = outcomes.pop(hostile.FALSE, 0), outcomes.pop(hostile.RIGHT, 0)
        rejected = dict(outcomes.most_common())
        reasons = ", ".join(f"{reason} {count}" for reason, count in rejected.items())
        self._row(
            "hostile",
            {
                "kind": kind, "matcher": matcher, "frames": len(verdicts), "false_fixes": false, "right": right,
                "rejected": rejected,
            },
            f"| {kind} | {matcher} | {len(verdicts)} | {false} | {right} | {reasons} |",
        )  # fmt: skip
        if is_judged:
            self._targets += [(f"{kind} {matcher}", target) for target in hostile.targets(len(verdicts), false)]

    def comparisons(self, found: Sequence[Comparison]) -> None:
        self._heading(_COMPARISON)
        for one in found:
            self._row(
                "comparison",
                msgspec.to_builtins(one),
                f"| {one.theirs} | {one.ours} | {one.frames} | {one.both} | {_number(one.te_ratio, 2)} | "
                f"{_number(one.cpu_ratio, 1)} |",
            )

    def targets(self) -> None:
        """Of what was judged since the last time."""
        if self._targets:
            self._heading(_TARGETS)
        for about, target in self._targets:
            self._row(
                "target",
                {"on": about, **msgspec.to_builtins(target)},
                f"| {target.what} | {about} | {target.limit} | {_number(target.measured, 2)} | "
                f"{'yes' if target.met else '**no**'} |",
            )
        self._targets = []
        self._blank()

    def false_fixes(self, verdicts: Sequence[Verdict]) -> None:
        """Each with what it takes to see it again: ``--trials`` with its number and the same sets and seed."""
        if not verdicts:
            return
        self._heading(_FALSE_FIXES)
        for v in verdicts:
            self._row(
                "false_fix",
                msgspec.to_builtins(v),
                f"| {v.number} | {v.kind} | {v.name} | {v.frame} | {v.shown or '-'} | {v.matcher} | "
                f"{_number(v.te_m, 2)} | {_number(v.re_deg, 2)} | {v.inliers} / {v.matches} | {_number(v.rms_px, 2)} |",
            )
        self._blank()

    def _row(self, kind: str, found: dict[str, Any], line: str) -> None:
        print(msgspec.json.encode({"row": kind, **found}).decode() if self._as_json else line, flush=True)

    def _heading(self, columns: str) -> None:
        if not self._as_json:
            print()
            print_heading(columns)

    def _blank(self) -> None:
        if not self._as_json:
            print()


def _figures_row(f: Figures) -> str:
    te = " / ".join(_number(v, 2) for v in (f.te_m.median, f.te_m.p90, f.te_m.max))
    recall = " | ".join(f"{100 * part:.1f} %" for part in f.recall.values())
    return (
        f"| {f.name} | {f.matcher} | {f.query_px} | {f.frames} | {recall} | {te} | {_number(f.re_deg.median, 2)} | "
        f"{f.false_fixes} | {_number(f.nees_per_dof, 2)} | {_number(f.nees.p95, 1)} | {f.unprotected} | "
        f"{_number(f.cpu_ms.median, 1)} / {_number(f.cpu_ms.p99, 1)} | "
        f"{_number(f.wall_ms.median, 1)} / {_number(f.wall_ms.p99, 1)} | {_number(f.wall_p99_over_median, 2)} |"
    )


def _how(take: Take) -> str:
    error = take.result.error
    if error is None:
        return str(getattr(take.result.outcome, "reason", ""))
    return f"{error.te_m:.2f} m {error.re_deg:.2f}°"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"
