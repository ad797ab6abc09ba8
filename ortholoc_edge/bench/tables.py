"""Tables of a benchmark: as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

Cell = str | float | None

_LATEX = str.maketrans(
    {"%": r"\%", "_": r"\_", "&": r"\&", "#": r"\#", "°": r"$^\circ$", "±": r"$\pm$", "²": "$^2$", "×": r"$\times$"}
)


@dataclass(frozen=True, slots=True)
class Column:
    """A heading, and to how many digits its numbers are shown; CSV has them all."""

    heading: str
    digits: int = 2


@dataclass(frozen=True, slots=True)
class Table:
    """
    Attributes:
        name: of its files.
        rows: as many cells as columns; None: nothing to tell, infinite: no pose, or none in that part of them.
    """

    name: str
    title: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]

    def __post_init__(self) -> None:
        if any(len(row) != len(self.columns) for row in self.rows):
            raise ValueError(f"table {self.name}: a row has not {len(self.columns)} cells")

    def markdown(self) -> str:
        lines = [
            f"| {' | '.join(column.heading for column in self.columns)} |",
            f"|{'---|' * len(self.columns)}",
            *(f"| {' | '.join(self._shown(row))} |" for row in self.rows),
        ]
        return "\n".join(lines) + "\n"

    def latex(self) -> str:
        r"""A ``tabular`` with ``booktabs``' rules."""

        def line(cells: Sequence[str]) -> str:
            return " & ".join(cell.translate(_LATEX).replace("∞", r"$\infty$") for cell in cells) + r" \\"

        spec = "".join("l" if self._is_text(k) else "r" for k in range(len(self.columns)))
        return "\n".join(
            [
                f"% {self.title}",
                rf"\begin{{tabular}}{{{spec}}}",
                r"\toprule",
                line([column.heading for column in self.columns]),
                r"\midrule",
                *(line(self._shown(row)) for row in self.rows),
                r"\bottomrule",
                r"\end{tabular}",
                "",
            ]
        )

    def csv(self) -> str:
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([column.heading for column in self.columns])
        writer.writerows(["" if cell is None else cell for cell in row] for row in self.rows)
        return text.getvalue()

    def _is_text(self, index: int) -> bool:
        return any(isinstance(row[index], str) for row in self.rows)

    def _shown(self, row: Sequence[Cell]) -> list[str]:
        return [shown(cell, column.digits) for cell, column in zip(row, self.columns, strict=True)]


def shown(cell: Cell, digits: int) -> str:
    """For people."""
    if cell is None:
        return "-"
    if isinstance(cell, str):
        return cell
    return f"{cell:.{digits}f}" if math.isfinite(cell) else "∞"
