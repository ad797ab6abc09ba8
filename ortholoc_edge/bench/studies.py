"""What a benchmark asks, and its answers as tables.

Paper, tables "Quantitative Localization Results", "Quantitative Calibration Results", "Across Domain Configurations"
and "Using Ground-Truth Matchings", appendix "Resolution Analysis" and "Covisibility Analysis".
"""

from __future__ import annotations

import csv
import importlib.resources
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, TypeVar

import numpy as np

from ortholoc_edge.bench.campaign import GROUND_TRUTH, Piece
from ortholoc_edge.bench.condition import USUAL, Condition
from ortholoc_edge.bench.metrics import RECALL_LIMITS, SampleSummary, recall
from ortholoc_edge.bench.paper import Result, Task
from ortholoc_edge.bench.samples import SampleKind
from ortholoc_edge.bench.tables import Cell, Column, Table

_KINDS: Final = tuple(SampleKind)
# Lower edges of the classes; the last is open.
_HEIGHTS_M: Final = (0.0, 50.0, 75.0, 100.0, 150.0)
_TILTS_DEG: Final = (0.0, 15.0, 30.0, 45.0, 60.0)

Measured = tuple[Piece, Result]
_K = TypeVar("_K")


@dataclass(frozen=True, slots=True)
class Study:
    """A table and a plot of errors against something.

    Attributes:
        name: of its files.
        title: for people.
        headings: of what it is against.
        values: of a result, as many; None: it takes no part.
        conditions: that it needs, beside the usual one.
        of_truth: about the truth as matches, not about matchers.
        digits: of errors.
    """

    name: str
    title: str
    headings: tuple[str, ...]
    values: Callable[[Piece, Result], tuple[Cell, ...] | None]
    conditions: tuple[Condition, ...] = ()
    of_truth: bool = False
    digits: int = 2


def _usual(value: Callable[[Piece], Cell]) -> Callable[[Piece, Result], tuple[Cell, ...] | None]:
    return lambda piece, result: (value(piece),) if result.condition == USUAL else None


def _class_of(value: float, edges: Sequence[float]) -> str:
    for low, high in pairwise((*edges, math.inf)):
        if value < high:
            return f"{low:g} to {high:g}" if math.isfinite(high) else f"{low:g} and more"
    return "unknown"


def _only(name: str) -> Callable[[Piece, Result], tuple[Cell, ...] | None]:
    """A condition's value where all else is usual."""

    def values(_: Piece, result: Result) -> tuple[Cell, ...] | None:
        at: float = getattr(result.condition, name)
        return (at,) if result.condition == Condition(**{name: at}) else None

    return values


def _by_confidence(piece: Piece, result: Result) -> tuple[Cell, ...] | None:
    (above,) = _only("min_confidence")(piece, result) or (None,)
    return None if above is None else (str(piece.kind), above)


def _series(name: str, values: Sequence[float]) -> tuple[Condition, ...]:
    return tuple(Condition(**{name: value}) for value in values)


_SCALES: Final = (0.75, 0.5, 0.3, 0.2, 0.1)

STUDIES: Final[Mapping[str, tuple[Study, ...]]] = {
    "domain": (Study("domain", "By what lies between map and photo", ("kind",), _usual(lambda p: str(p.kind))),),
    "height": (
        Study("height", "By height above ground", ("height m",), _usual(lambda p: _class_of(p.height_m, _HEIGHTS_M))),
    ),
    "tilt": (
        Study("tilt", "By the camera's tilt from straight down", ("tilt °",),
              _usual(lambda p: _class_of(p.tilt_deg, _TILTS_DEG))),
    ),
    "resolution": (
        Study("raster", "By the resolution of orthophoto and surface model", ("raster scale",), _only("raster_scale"),
              _series("raster_scale", _SCALES)),
        Study("query", "By the resolution of the photo", ("photo scale",), _only("query_scale"),
              _series("query_scale", _SCALES)),
    ),
    "covisibility": (
        Study("covisibility", "By the part of what the photo shows that is on the map", ("covisibility",),
              _only("covisibility"), _series("covisibility", (0.75, 0.5, 0.35, 0.2, 0.1, 0.05))),
    ),
    "confidence": (
        Study("confidence", "True matches above a geometry-aware confidence", ("kind", "confidence above"),
              _by_confidence, _series("min_confidence", (0.0, 0.5, 0.95, 0.99)), of_truth=True, digits=4),
    ),
}  # fmt: skip


def conditions_for(matcher: str, studies: Iterable[Study]) -> list[Condition]:
    """All that a matcher has to go through, the usual one first."""
    mine = [study for study in studies if study.of_truth == (matcher == GROUND_TRUTH)]
    return list(dict.fromkeys([USUAL, *(condition for study in mine for condition in study.conditions)]))


# -- answers ---------------------------------------------------------------------------------------------


def measured(pieces: Iterable[Piece], task: Task) -> list[Measured]:
    return [(piece, result) for piece in pieces for result in piece.results if result.task == task]


def main_table(pieces: Iterable[Piece], task: Task) -> Table:
    """One row per matcher and AdHoP setting under the usual condition, with the paper's figures of it beside."""
    usual = [(p, r) for p, r in measured(pieces, task) if r.condition == USUAL]
    published = paper_figures()
    rows: list[list[Cell]] = []
    for (matcher, adhop), found in _grouped(usual, lambda p, r: (p.matcher, r.adhop)).items():
        paper = published.get((task, matcher, adhop), {})
        beside: list[Cell] = [paper.get(name) for name in ("te_m", *RECALL_LIMITS)]
        rows.append([matcher, _on(adhop), *_figures(found, task), *beside])
    columns = [
        Column("matcher"), Column("AdHoP"), *_figure_columns(task),
        Column("paper: TE m"), *(Column(f"paper: {_limits(name)} %", 1) for name in RECALL_LIMITS),
    ]  # fmt: skip
    return Table(str(task), f"{task.capitalize()}: all samples", columns, rows)


def study_table(pieces: Iterable[Piece], study: Study, task: Task) -> Table:
    """One row per matcher, AdHoP setting and value."""
    groups: dict[tuple[str, bool, tuple[Cell, ...]], list[Measured]] = defaultdict(list)
    for piece, result in measured(pieces, task):
        values = study.values(piece, result) if (piece.matcher == GROUND_TRUTH) == study.of_truth else None
        if values is not None:
            groups[piece.matcher, result.adhop, values].append((piece, result))
    rows: list[list[Cell]] = []
    for (matcher, adhop, values), found in sorted(groups.items(), key=lambda item: _order(*item[0])):
        kept = [100.0 * r.matches / max(r.found, 1) for _, r in found]
        truth: list[Cell] = [float(np.mean(kept))] if study.of_truth else []
        rows.append([matcher, _on(adhop), *values, *truth, *_figures(found, task)])
    columns = [
        Column("matcher"), Column("AdHoP"), *(Column(heading) for heading in study.headings),
        *([Column("matches kept %", 1)] if study.of_truth else []), *_figure_columns(task, study.digits),
    ]  # fmt: skip
    return Table(f"{study.name}_{task}", f"{study.title}: {task}", columns, rows)


def adhop_table(pieces: Iterable[Piece], task: Task) -> Table:
    """What AdHoP changes, sample by sample, where both settings were run."""
    pairs: dict[str, list[tuple[Result, Result]]] = defaultdict(list)
    for piece in pieces:
        by_setting = {r.adhop: r for r in piece.results if r.task == task and r.condition == USUAL}
        if len(by_setting) == 2:
            pairs[piece.matcher].append((by_setting[False], by_setting[True]))
    rows = [[matcher, *_adhop_figures(found)] for matcher, found in pairs.items()]
    columns = [
        Column("matcher"), Column("samples", 0), Column("taken %", 1), Column("ME px without"), Column("ME px with"),
        Column("TE m without"), Column("TE m with"), Column("1m-1° gained", 0), Column("1m-1° lost", 0),
        Column("taken though TE worse", 0),
    ]  # fmt: skip
    return Table(f"adhop_{task}", f"What AdHoP changes: {task}", columns, rows)


def _adhop_figures(pairs: Sequence[tuple[Result, Result]]) -> list[Cell]:
    def within(result: Result) -> bool:
        return recall([result.error], 1)["1m_1deg"] > 0

    before, after = ([pair[k].error for pair in pairs] for k in (0, 1))
    taken = [pair for pair in pairs if pair[1].adhop_accepted]
    return [
        float(len(pairs)),
        100.0 * len(taken) / len(pairs),
        _median([e.me_px for e in before]),
        _median([e.me_px for e in after]),
        _median([e.te_m for e in before]),
        _median([e.te_m for e in after]),
        float(sum(within(b) and not within(a) for a, b in pairs)),
        float(sum(within(a) and not within(b) for a, b in pairs)),
        float(sum(b.error.te_m > a.error.te_m for a, b in taken)),
    ]


def _grouped(found: Iterable[Measured], key: Callable[[Piece, Result], _K]) -> dict[_K, list[Measured]]:
    groups: dict[_K, list[Measured]] = defaultdict(list)
    for piece, result in found:
        groups[key(piece, result)].append((piece, result))
    return dict(groups)


def _figure_columns(task: Task, digits: int = 2) -> list[Column]:
    focal = [Column("RFE %"), Column("called calibrated %", 1), Column("RFE % of those")]
    return [
        Column("samples", 0), Column("no pose", 0), Column("matches", 0), Column("ME px", 1),
        *(focal if task is Task.CALIBRATE else []),
        Column("TE m", digits), Column("TE m p90", digits), Column("TE m p99", digits), Column("RE °", digits),
        Column("RPE px", digits), *(Column(f"{_limits(name)} %", 1) for name in RECALL_LIMITS),
        Column("CPU s"), Column("wall s"),
    ]  # fmt: skip


def _figures(found: Sequence[Measured], task: Task) -> list[Cell]:
    results = [result for _, result in found]
    summary = SampleSummary.of([result.error for result in results])
    focal: list[Cell] = []
    if task is Task.CALIBRATE:
        called = [result for result in results if result.calibrated]
        focal = [
            _percent(summary.rfe.median),
            100.0 * len(called) / len(results),
            _percent(_median([r.error.rfe for r in called if r.error.rfe is not None])),
        ]
    return [
        float(summary.samples),
        float(summary.without_pose),
        float(np.median([result.matches for result in results])),
        summary.me_px.median,
        *focal,
        summary.te_m.median,
        summary.te_m.p90,
        summary.te_m.p99,
        summary.re_deg.median,
        summary.rpe_px.median,
        *(100.0 * part for part in summary.recall.values()),
        float(np.median([result.cpu_s for result in results])),
        float(np.median([result.wall_s for result in results])),
    ]


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _percent(part: float | None) -> float | None:
    return None if part is None else 100.0 * part


def _on(adhop: bool) -> str:
    return "on" if adhop else "off"


def _limits(name: str) -> str:
    """``1m-1°`` of ``1m_1deg``."""
    return name.replace("_", "-").replace("deg", "°")


def _order(matcher: str, adhop: bool, values: tuple[Cell, ...]) -> tuple[str, bool, tuple[float, ...]]:
    return matcher, adhop, tuple(_rank(value) for value in values)


def _rank(value: Cell) -> float:
    """Kinds as they are listed, classes by where they begin, and numbers with the best first, which is the largest."""
    if not isinstance(value, str):
        return -(value or 0.0)
    return float(_KINDS.index(SampleKind(value))) if value in _KINDS else float(value.split()[0])


def paper_figures() -> dict[tuple[Task, str, bool], dict[str, float]]:
    """The paper's medians and recalls (%) on its two test sets, by task, our matcher's name and AdHoP."""
    text = importlib.resources.files("ortholoc_edge.bench").joinpath("data/paper.csv").read_text("utf-8")
    return {
        (Task(row["task"]), row["matcher"], row["adhop"] == "on"): {
            name: float(row[name]) for name in row if name not in ("task", "matcher", "paper", "adhop") and row[name]
        }
        for row in csv.DictReader(text.splitlines())
    }
