"""A benchmark as one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence

import cv2

from ortholoc_edge.bench.tables import Table, shown
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry.arrays import ImageArray

_JPEG_QUALITY = 82
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#0f172a;background:#fff;margin:0 auto;padding:24px;max-width:1400px}
h1{font-size:22px;margin:0 0 4px}h2{font-size:17px;margin:28px 0 6px}.note{color:#475569;font-size:13px}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:13px;font-variant-numeric:tabular-nums}
th,td{padding:3px 10px;text-align:right;border-bottom:1px solid #e2e8f0;white-space:nowrap}
th{background:#f1f5f9;font-weight:600}td.t,th.t{text-align:left}
img{max-width:100%;height:auto;border:1px solid #cbd5e1}figure{margin:0 0 16px}figcaption{font-size:13px;color:#334155}
"""


def page(
    title: str,
    notes: Sequence[str],
    tables: Iterable[tuple[Table, bytes | None]],
    pictures: Iterable[tuple[str, ImageArray]],
) -> str:
    """
    Args:
        tables: each with its plot (PNG) or None.
        pictures: RGB, with captions.
    Raises: OrtholocError for a picture that can't be encoded.
    """
    parts = [f"<h1>{html.escape(title)}</h1>", *(f'<p class="note">{html.escape(note)}</p>' for note in notes)]
    for table, plot in tables:
        parts.append(f"<h2>{html.escape(table.title)}</h2>{_table(table)}")
        if plot is not None:
            parts.append(_image("png", plot, table.title))
    parts.append("<h2>Cases</h2>")
    for caption, picture in pictures:
        encoded, data = cv2.imencode(
            ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        )
        if not encoded:
            raise OrtholocError(f"{caption}: the picture can't be encoded; please report it")
        parts.append(
            f"<figure>{_image('jpeg', data.tobytes(), caption)}<figcaption>{html.escape(caption)}</figcaption></figure>"
        )
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body>\n'
        + "\n".join(parts)
        + "\n</body></html>\n"
    )


def _table(table: Table) -> str:
    text = [any(isinstance(row[k], str) for row in table.rows) for k in range(len(table.columns))]

    def cells(tag: str, values: Iterable[str]) -> str:
        return "".join(
            f'<{tag}{" class=t" if is_text else ""}>{html.escape(value)}</{tag}>'
            for value, is_text in zip(values, text, strict=True)
        )

    head = cells("th", (column.heading for column in table.columns))
    rows = "".join(
        f"<tr>{cells('td', (shown(cell, column.digits) for cell, column in zip(row, table.columns, strict=True)))}</tr>"
        for row in table.rows
    )
    return f'<div class="wide"><table><tr>{head}</tr>{rows}</table></div>'


def _image(kind: str, data: bytes, what: str) -> str:
    encoded = base64.b64encode(data).decode()
    return f'<img alt="{html.escape(what, quote=True)}" src="data:image/{kind};base64,{encoded}">'
