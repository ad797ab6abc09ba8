"""Plots of a benchmark's studies."""

from __future__ import annotations

import importlib
import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from ortholoc_edge.bench.tables import Cell, Table
from ortholoc_edge.errors import ConfigError

# What has no pose is drawn here, above all errors, so that it is seen.
_MOST_M = 1000.0
_LEAST_M = 0.001


def study_plot(table: Table, headings: Sequence[str]) -> bytes:
    """Median position error and recall within 1 m and 1 degree, as PNG: a line for each matcher, dashed without AdHoP.

    Args:
        headings: columns of the table: what each line is of, beside the matcher, and last what it is against.
    Raises: ConfigError without matplotlib.
    """
    try:
        # Not at the top: it is no part of what flies.
        matplotlib: Any = importlib.import_module("matplotlib")
        figure_kind: Any = importlib.import_module("matplotlib.figure").Figure
    except ImportError as err:
        raise ConfigError("plots need matplotlib; install it with: pip install 'ortholoc-edge[report]'") from err
    with matplotlib.rc_context({"font.size": 9, "svg.hashsalt": "0"}):
        figure = figure_kind(figsize=(10, 4), dpi=120, layout="constrained")
        error, recall = figure.subplots(1, 2)
        ticks = list(dict.fromkeys(_column(table, headings[-1])))
        # By place and not by value where they are names or steps of unlike size.
        place = {value: k for k, value in enumerate(ticks)}
        colours = {name: f"C{k % 10}" for k, name in enumerate(dict.fromkeys(_column(table, "matcher")))}
        *of, against = headings
        for (matcher, adhop, *parts), rows in _lines(table, of).items():
            x = [place[row[against]] for row in rows]
            style = {
                "color": colours[matcher], "linestyle": "-" if adhop == "on" else "--", "marker": "o", "markersize": 4,
                "label": ", ".join([str(matcher), f"AdHoP {adhop}", *map(str, parts)]),
            }  # fmt: skip
            te_m = np.clip(np.array([row["TE m"] for row in rows], dtype=float), _LEAST_M, _MOST_M)
            error.plot(x, te_m, **style)
            recall.plot(x, [row["1m-1° %"] for row in rows], **style)
        error.set(yscale="log", ylabel="median position error, m (no pose: at the top)")
        recall.set(ylabel="recall within 1 m and 1°, %", ylim=(-3, 103))
        for axes in (error, recall):
            names = [f"{tick:g}" if isinstance(tick, float) else str(tick) for tick in ticks]
            axes.set_xticks(range(len(ticks)), names)
            axes.set_xlabel(against)
            axes.grid(alpha=0.3)
        figure.suptitle(table.title)
        figure.legend(*recall.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
        data = io.BytesIO()
        # No software or date in it: the same figures give the same bytes.
        figure.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()


def _column(table: Table, heading: str) -> list[Cell]:
    index = [column.heading for column in table.columns].index(heading)
    return [row[index] for row in table.rows]


def _lines(table: Table, of: Sequence[str]) -> dict[tuple[Cell, ...], list[dict[str, Any]]]:
    lines: dict[tuple[Cell, ...], list[dict[str, Any]]] = {}
    for row in table.rows:
        cells = dict(zip((column.heading for column in table.columns), row, strict=True))
        lines.setdefault(tuple(cells[heading] for heading in ("matcher", "AdHoP", *of)), []).append(cells)
    return lines
