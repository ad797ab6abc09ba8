"""A profile as one SVG that needs nothing else: how long frames take, and what they are worth."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from typing import Final

from ortholoc_edge.bench.profile import Profile, Row

_WIDTH: Final = 1150
_ROW: Final = 26
# Of the bars: where they begin and end; right of them a line of words.
_LEFT, _RIGHT, _TOP = 370, 780, 64
# Of the chart below them.
_CHART: Final = 250
_COLOURS: Final = ("#1d4ed8", "#c2410c", "#15803d", "#7c3aed", "#be123c", "#0e7490", "#a16207", "#475569")
_LIMIT: Final = "#b91c1c"
_STYLE: Final = (
    "text{font:13px system-ui,sans-serif;fill:#0f172a}.s{font-size:12px;fill:#475569}.h{font-size:16px;font-weight:600}"
)


def profile_svg(profile: Profile) -> str:
    """Bars of frame times, each with what came of it, and below the median error (or the distance from full detail)
    against the slowest of a hundred frames."""
    rows = profile.rows
    colours = _colours(rows)
    points = [(row, worth) for row in rows if (worth := _worth(row)) is not None and worth > 0.0]
    chart_top = _TOP + _ROW * len(rows) + 60
    height = chart_top + (_CHART + 60 if len(points) > 1 else 0)
    limit_ms = None if profile.recommendation is None else profile.recommendation.bounds.limit_ms
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" width="{_WIDTH}" height="{height}">',
        f"<style>{_STYLE}</style>",
        f'<rect width="{_WIDTH}" height="{height}" fill="#fff"/>',
        _text(16, 24, "Time of a frame", "h"),
        _text(16, 44, _caption(profile), "s"),
        *_bars(profile, colours, limit_ms),
    ]
    if len(points) > 1:
        parts += _chart(points, colours, limit_ms, chart_top)
    return "".join([*parts, "</svg>"]) + "\n"


def _caption(profile: Profile) -> str:
    begun, ended = profile.load
    return (
        f"{profile.source}, {profile.rows[0].timed} frames each, in turn; load {begun:.1f} to {ended:.1f}. "
        "Bar: median; pale: to the 95th of a hundred; mark: the 99th; yellow: recommended."
    )


def _colours(rows: Sequence[Row]) -> dict[tuple[str, int], str]:
    lines = dict.fromkeys((row.setting.name, row.setting.threads) for row in rows)
    return {line: _COLOURS[number % len(_COLOURS)] for number, line in enumerate(lines)}


def _worth(row: Row) -> float | None:
    if row.accuracy is not None:
        return row.accuracy.te_m.median
    return None if row.agreement is None else row.agreement.apart_m.median


def _text(x: float, y: float, words: str, style: str = "", anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{style}" text-anchor="{anchor}">{html.escape(words)}</text>'


def _bars(profile: Profile, colours: dict[tuple[str, int], str], limit_ms: float | None) -> list[str]:
    rows = profile.rows
    longest = 1.05 * max([row.frame_ms.p99 for row in rows] + ([] if limit_ms is None else [limit_ms]))
    bottom = _TOP + _ROW * len(rows)

    def x(ms: float) -> float:
        return _LEFT + (_RIGHT - _LEFT) * ms / longest

    parts = []
    step = _step(longest, 6)
    for number in range(math.floor(longest / step) + 1):
        at = x(number * step)
        parts.append(f'<path d="M{at:.1f} {_TOP}V{bottom}" stroke="#e2e8f0"/>')
        parts.append(_text(at, bottom + 18, f"{number * step:g}", "s", "middle"))
    parts.append(_text(_RIGHT + 8, bottom + 18, "ms", "s"))
    best = None if profile.recommendation is None else profile.recommendation.row
    for number, row in enumerate(rows):
        y = _TOP + _ROW * number + 5
        colour, spent = colours[row.setting.name, row.setting.threads], row.frame_ms
        if number == best:
            parts.append(f'<rect x="8" y="{y - 4}" width="{_WIDTH - 16}" height="{_ROW - 2}" fill="#fef9c3"/>')
        parts.append(_text(_LEFT - 10, y + 12, row.setting.label, "", "end"))
        for width, opacity in ((spent.p95, 0.3), (spent.median, 1.0)):
            parts.append(
                f'<rect x="{_LEFT}" y="{y}" width="{x(width) - _LEFT:.1f}" height="{_ROW - 10}" fill="{colour}" '
                f'opacity="{opacity}"/>'
            )
        parts.append(f'<path d="M{x(spent.p99):.1f} {y - 1}v{_ROW - 8}" stroke="{colour}" stroke-width="2.5"/>')
        parts.append(_text(_RIGHT + 14, y + 12, _words(row), "s"))
    if limit_ms is not None:
        parts.append(f'<path d="M{x(limit_ms):.1f} {_TOP - 6}V{bottom}" stroke="{_LIMIT}" stroke-dasharray="5 3"/>')
        parts.append(_text(x(limit_ms), bottom + 34, f"{1000.0 / limit_ms:g} Hz", "s", "middle"))
    return parts


def _words(row: Row) -> str:
    words = f"CPU {row.cpu_ms.median:.0f} ms, {row.rss_mb:.0f} MB"
    if row.accuracy is not None:
        median = row.accuracy.te_m.median
        error = "no fix" if median is None else f"{median:.2f} m"
        return f"{error}, recall {100 * next(iter(row.accuracy.recall.values())):.0f} %; {words}"
    if row.agreement is not None:
        return f"verdict as full detail's {100 * row.agreement.same_verdict:.0f} %; {words}"
    return f"{row.fixes} of {row.frames} fixes; {words}"


def _chart(
    points: Sequence[tuple[Row, float]], colours: dict[tuple[str, int], str], limit_ms: float | None, top: int
) -> list[str]:
    """Both axes logarithmic."""
    bottom = top + _CHART
    times = [row.frame_ms.p99 for row, _ in points] + ([] if limit_ms is None else [limit_ms])
    errors = [worth for _, worth in points]
    left_ms, right_ms = min(times) / 1.3, max(times) * 1.3
    low_m, high_m = min(errors) / 1.4, max(errors) * 1.4

    def x(ms: float) -> float:
        return _LEFT + (_RIGHT - _LEFT) * math.log(ms / left_ms) / math.log(right_ms / left_ms)

    def y(metres: float) -> float:
        return bottom - _CHART * math.log(metres / low_m) / math.log(high_m / low_m)

    truth = points[0][0].accuracy is not None
    what = "median position error, m" if truth else "median distance from full detail's fix, m"
    parts = [_text(_LEFT, top - 10, f"{what}, against the 99th of a hundred frames, ms")]
    for value in _marks(left_ms, right_ms):
        parts.append(f'<path d="M{x(value):.1f} {top}V{bottom}" stroke="#e2e8f0"/>')
        parts.append(_text(x(value), bottom + 18, f"{value:g}", "s", "middle"))
    for value in _marks(low_m, high_m):
        parts.append(f'<path d="M{_LEFT} {y(value):.1f}H{_RIGHT}" stroke="#e2e8f0"/>')
        parts.append(_text(_LEFT - 8, y(value) + 4, f"{value:g}", "s", "end"))
    if limit_ms is not None:
        parts.append(f'<path d="M{x(limit_ms):.1f} {top}V{bottom}" stroke="{_LIMIT}" stroke-dasharray="5 3"/>')
    for number, (line, colour) in enumerate(colours.items()):
        own = [(row, worth) for row, worth in points if (row.setting.name, row.setting.threads) == line]
        if not own:
            continue
        path = " ".join(f"{x(row.frame_ms.p99):.1f},{y(worth):.1f}" for row, worth in own)
        parts.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        for row, worth in own:
            at, over = x(row.frame_ms.p99), y(worth)
            parts.append(f'<circle cx="{at:.1f}" cy="{over:.1f}" r="4" fill="{colour}"/>')
            parts.append(_text(at + 7, over - 6, row.setting.px, "s"))
        legend = top + 14 + 20 * number
        parts.append(f'<rect x="{_RIGHT + 14}" y="{legend - 10}" width="12" height="12" fill="{colour}"/>')
        threads = f", {line[1]} threads" if line[1] > 1 else ""
        parts.append(_text(_RIGHT + 34, legend, f"{line[0]}{threads}"))
    return parts


def _step(span: float, count: int) -> float:
    raw = span / count
    power = 10.0 ** math.floor(math.log10(raw))
    return next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= raw * 0.999)


def _marks(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten between."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [k * 10.0**power for power in powers for k in (1, 2, 5) if low <= k * 10.0**power <= high]
