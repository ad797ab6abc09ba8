"""The report of a simulated flight as one HTML file that needs nothing else: no scripts, no fonts, no network."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ortholoc_edge.bench import draw
from ortholoc_edge.bench.metrics import Spread
from ortholoc_edge.errors import OrtholocError
from ortholoc_edge.geometry.arrays import BoolArray, FloatArray, ImageArray
from ortholoc_edge.geometry.grid import RasterGrid
from ortholoc_edge.pipeline.outcome import Fix
from ortholoc_edge.tiles.lattice import Bounds
from ortholoc_edge.tiles.pack import Pack
from ortholoc_edge.tiles.store import MapStore
from ortholoc_sim.judgement import Judged
from ortholoc_sim.lockstep import FlownFrame

_TRUTH, _AUTOPILOT, _VISION, _DEAD, _ROUTE = "#15803d", "#c2410c", "#be123c", "#64748b", "#1d4ed8"
_SIGMA = "#7c3aed"
_GNSS_BAND, _FAULT_BAND = "#fde68a", "#c7d2fe"
_REASONS = ("#475569", "#b45309", "#0e7490", "#7c2d12", "#4d7c0f", "#86198f", "#334155", "#9f1239")
_MAP_PX, _MAP_MARGIN_M = 900, 60.0
_JPEG_QUALITY = 72
_WIDTH, _HEIGHT = 900, 150
_LEFT, _RIGHT, _TOP, _BOTTOM = 130, 12, 10, 24
_MOST_POINTS = 900
_FIX_DOT_PX = 3.2
_THUMB_PX = 400
_GENERATED = "over a generated country, which is no real place"
# 95 % of NEES of six degrees of freedom, over six, lie between.
_NEES_BAND = (1.237 / 6.0, 14.449 / 6.0)
_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#0f172a;background:#fff;margin:0 auto;padding:24px;max-width:940px}
h1{font-size:22px;margin:0 0 4px}h2{font-size:17px;margin:28px 0 6px}p{margin:4px 0}
.badge{display:inline-block;padding:1px 10px;border-radius:4px;color:#fff;font-weight:600;font-size:14px}
.ok{background:#15803d}.bad{background:#b91c1c}.note{color:#475569;font-size:13px}
table{border-collapse:collapse;font-size:14px}td,th{padding:2px 14px 2px 0;text-align:left;vertical-align:top}
th{font-weight:600;color:#334155}td.n{font-variant-numeric:tabular-nums}
svg{display:block;max-width:100%;height:auto}svg text{font:12px system-ui,sans-serif;fill:#334155}
.legend span{margin-right:16px;font-size:13px;white-space:nowrap}
.legend i{display:inline-block;width:18px;height:0;border-top:3px solid;margin-right:5px;vertical-align:middle}
figure{display:inline-block;margin:0 12px 14px 0;width:min(100%,440px);vertical-align:top}
figure img{width:100%;border:1px solid #cbd5e1}figcaption{font-size:13px;color:#334155}
"""


def write_page(judged: Judged, path: Path) -> None:
    """Write the report. Raises: OrtholocError if it can't be written."""
    with MapStore(Pack.open(judged.flown.pack)) as store:
        parts = [_head(judged), _map(judged, store), _charts(judged), _said(judged), _pictures(judged, store)]
    title = html.escape(f"{judged.result.scenario}, seed {judged.result.seed}")
    text = (
        f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body>\n'
        + "\n".join(parts)
        + "\n</body></html>\n"
    )
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as err:
        raise OrtholocError(f"{path}: can't write the report ({err})") from err


# -- figures in words --------------------------------------------------------


def _head(judged: Judged) -> str:
    r = judged.result
    word, shade = ("as expected", "ok") if r.passed else ("not as expected", "bad")
    badge = f'<span class="badge {shade}">{word}</span>'
    event = "never" if r.event_s is None else f"from {r.event_s:g} s"
    nees = "-" if r.nees.pose is None else (
        f"{r.nees.pose:.2f} (position {r.nees.position:.2f}, attitude {r.nees.attitude:.2f}); 1 is honest"
    )  # fmt: skip
    rejected = ", ".join(f"{reason} {count}" for reason, count in r.rejections.items()) or "none"
    route_p95 = "-" if r.route_p95_m is None else f"95 % within {r.route_p95_m:.2f} m; {_spread(r.route_m, 'm')}"
    rows = [
        (
            "flight",
            f"{r.flown_m:.0f} m in {r.duration_s:.0f} s, GNSS disturbed {event}; map {r.map_kind}, seed {r.seed}",
        ),
        ("frames", f"{r.exposed} taken, {r.replaced} replaced by newer ones, {r.fixes} of {r.frames} gave a fix"),
        ("refused", rejected),
        ("false fixes", f"{r.false_fixes}"),
        ("fix error", f"{_spread(r.position_m, 'm')}; {_spread(r.attitude_deg, '°')}"),
        ("NEES / degrees of freedom", nees),
        ("off the route, by truth", route_p95),
        ("autopilot's error", f"{_spread(r.autopilot_m, 'm')}; {r.autopilot_end_m:.1f} m at the end"),
        ("dead reckoning alone", "-" if r.dead_reckoning_m is None else f"{r.dead_reckoning_m:.1f} m off at the end"),
        ("autopilot's filter", ", ".join(f"{verdict} {n}" for verdict, n in r.verdicts.items()) or "received nothing"),
        ("latency, simulated", _spread(r.latency_ms, "ms")),
    ]
    problems = "".join(f"<p>&#10007; {html.escape(problem)}</p>" for problem in r.problems)
    table = "".join(f'<tr><th>{name}</th><td class="n">{html.escape(value)}</td></tr>' for name, value in rows)
    return (
        f"<h1>{html.escape(r.title)}</h1><p>{badge} <b>{html.escape(r.scenario)}</b> "
        f'<span class="note">{html.escape(f"a simulated flight; {r.notice or _GENERATED}")}</span></p>'
        f"{problems}<table>{table}</table>"
    )


def _spread(spread: Spread, unit: str) -> str:
    if spread.median is None or spread.p90 is None or spread.max is None:
        return "-"
    digits = 0 if unit == "ms" else 2
    return f"median {spread.median:.{digits}f}, p90 {spread.p90:.{digits}f}, most {spread.max:.{digits}f} {unit}"


def _said(judged: Judged) -> str:
    if not judged.result.says:
        return "<h2>What the pilot was told</h2><p>nothing</p>"
    rows = "".join(f'<tr><td class="n">{t_s:.1f} s</td><td>{html.escape(text)}</td></tr>' for t_s, text in
                   judged.result.says)  # fmt: skip
    return f"<h2>What the pilot was told</h2><table>{rows}</table>"


# -- the map -----------------------------------------------------------------


def _map(judged: Judged, store: MapStore) -> str:
    route = judged.flown.route_map_m[:, :2]
    tracks = np.concatenate([route, judged.true_map_m[:, :2], judged.believed_map_m[:, :2]])
    low, high = tracks.min(axis=0) - _MAP_MARGIN_M, tracks.max(axis=0) + _MAP_MARGIN_M
    # A vehicle that is lost may be anywhere: the map ends where the pack does.
    west, south, east, north = store.bounds
    low, high = np.maximum(low, (west, south)), np.minimum(high, (east, north))
    if not (high - low > 1.0).all():
        return "<h2>Map</h2><p>The flight does not lie on the map.</p>"
    picture = _backdrop(store, (float(low[0]), float(low[1]), float(high[0]), float(high[1])))
    if picture is None:
        return "<h2>Map</h2><p>The map has no picture here.</p>"
    image, grid = picture
    height, width = image.shape[:2]
    fixes = np.array([f.outcome.map_from_camera.translation for f in judged.flown.frames if isinstance(f.outcome, Fix)])
    parts = [
        f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" '
        'aria-label="map with the tracks of the flight">',
        f'<image href="{_jpeg(image)}" width="{width}" height="{height}" opacity="0.75"/>',
        _line_px(grid.px_from_map(route), "#fff", 6.0),
        _line_px(grid.px_from_map(route), _ROUTE, 1.5, "8 6"),
    ]
    if len(fixes) > 0:
        parts += [_dot(u, v, _VISION, _FIX_DOT_PX) for u, v in _thinned(grid.px_from_map(fixes[:, :2]))]
    # Over the dots, and the truth last: where all is well the lines lie on each other.
    parts += [
        _line_px(grid.px_from_map(judged.believed_map_m[:, :2]), _AUTOPILOT, 2.0),
        _line_px(grid.px_from_map(judged.true_map_m[:, :2]), _TRUTH, 1.4),
    ]
    for event in judged.flown.scenario.gnss:
        parts.append(_mark(judged, grid, event.from_s, f"GNSS {event.kind}"))
    for fault in judged.flown.scenario.fault:
        parts.append(_mark(judged, grid, fault.from_s, fault.kind.replace("_", " ")))
    parts += [_scale_bar(grid, height), "</svg>"]
    legend = _legend(
        [("route", _ROUTE), ("truth", _TRUTH), ("autopilot believes", _AUTOPILOT), ("fixes of the camera", _VISION)]
    )
    return f"<h2>Map</h2>{legend}{''.join(parts)}"


def _backdrop(store: MapStore, bounds: Bounds) -> tuple[ImageArray, RasterGrid] | None:
    gsd_m = max(bounds[2] - bounds[0], bounds[3] - bounds[1]) / _MAP_PX
    window = store.read_colour(bounds, gsd_m)
    if window is None:
        return None
    scale = min(1.0, _MAP_PX / max(window.rgb.shape[:2]))
    size = (max(1, round(window.grid.width * scale)), max(1, round(window.grid.height * scale)))
    image = np.asarray(cv2.resize(window.rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return image, window.grid.resized(*size)


def _mark(judged: Judged, grid: RasterGrid, t_s: float, text: str) -> str:
    if not len(judged.t_s) or t_s > judged.t_s[-1]:
        return ""
    u, v = grid.px_from_map(judged.true_map_m[int(np.searchsorted(judged.t_s, t_s)), :2])
    return (
        f'<circle cx="{u:.1f}" cy="{v:.1f}" r="6" fill="#fff" stroke="#0f172a" stroke-width="2"/>'
        f'<text x="{u + 10:.1f}" y="{v - 8:.1f}" stroke="#fff" stroke-width="3" paint-order="stroke">'
        f"{html.escape(text)}</text>"
    )


def _scale_bar(grid: RasterGrid, height: int) -> str:
    length_m = next(m for m in (1000, 500, 200, 100, 50, 20, 10) if m / abs(grid.dx) < 260 or m == 10)
    px = length_m / abs(grid.dx)
    return (
        f'<rect x="10" y="{height - 34}" width="{px + 16:.0f}" height="26" fill="#fff" opacity="0.85"/>'
        f'<path d="M18 {height - 14}h{px:.1f}" stroke="#0f172a" stroke-width="3"/>'
        f'<text x="18" y="{height - 20}">{length_m} m</text>'
    )


# -- over time ---------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Axes:
    """Time to the right, a value upward: linear, or logarithmic."""

    end_s: float
    low: float
    high: float
    is_log: bool = False

    def x(self, t_s: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * t_s / self.end_s

    def y(self, value: float) -> float:
        share = (self._scaled(value) - self._scaled(self.low)) / (self._scaled(self.high) - self._scaled(self.low))
        return _TOP + (_HEIGHT - _TOP - _BOTTOM) * (1.0 - min(max(share, 0.0), 1.0))

    def _scaled(self, value: float) -> float:
        return math.log10(max(value, 1e-9)) if self.is_log else value

    def ticks(self) -> list[float]:
        if self.is_log:
            return [10.0**k for k in range(math.ceil(math.log10(self.low)), math.floor(math.log10(self.high)) + 1)]
        step = _step(self.high - self.low, 4)
        return [k * step for k in range(math.ceil(self.low / step), math.floor(self.high / step + 1e-9) + 1)]


def _step(span: float, count: int) -> float:
    raw = span / count
    power = 10.0 ** math.floor(math.log10(max(raw, 1e-9)))
    return next(k * power for k in (1.0, 2.0, 5.0, 10.0) if k * power >= raw * 0.999)


def _charts(judged: Judged) -> str:
    t = judged.t_s
    end_s = max(float(t[-1]) if len(t) else 0.0, 1.0)
    fixes = [(f, e) for f, e in zip(judged.flown.frames, judged.errors, strict=True)
             if e is not None and isinstance(f.outcome, Fix)]  # fmt: skip
    fix_t = np.array([f.t_s for f, _ in fixes])
    error = np.array([float(np.linalg.norm(e.step_m)) for _, e in fixes])
    sigma = np.array([math.sqrt(float(np.trace(f.outcome.covariance[:3, :3]))) for f, _ in fixes
                      if isinstance(f.outcome, Fix)])  # fmt: skip
    nees = np.array([e.nees[0] / 6.0 for _, e in fixes])
    known = np.isfinite(judged.dead_reckoning_m)
    most = _top(judged.autopilot_m, judged.route_m)
    parts = ["<h2>Over time</h2>", _legend([("GNSS disturbed", _GNSS_BAND), ("fault", _FAULT_BAND)])]

    def chart(title: str, unit: str, axes: _Axes, body: Callable[[_Axes], str], legend: list[tuple[str, str]]) -> None:
        parts.append(f"<p><b>{title}</b> <span class=note>{unit}</span></p>{_legend(legend)}")
        parts.append(_frame(judged, axes, body(axes)))

    chart(
        "Autopilot", "m, horizontal", _Axes(end_s, 0.0, most),
        lambda axes: _line(axes, t[known], judged.dead_reckoning_m[known], _DEAD, "5 4")
        + _line(axes, t, judged.route_m, _TRUTH) + _line(axes, t, judged.autopilot_m, _AUTOPILOT),
        [("error of what it believes", _AUTOPILOT), ("truth off the route", _TRUTH),
         ("dead reckoning alone (may leave the chart)", _DEAD)],
    )  # fmt: skip
    if fixes:
        chart(
            "Fixes: error and what they say of it", "m, three-dimensional", _Axes(end_s, 0.0, _top(error, sigma)),
            lambda axes: _line(axes, fix_t, sigma, _SIGMA) + _dots(axes, fix_t, error, _VISION),
            [("error", _VISION), ("1 sigma", _SIGMA)],
        )  # fmt: skip
        chart(
            "NEES over its degrees of freedom", "95 % of honest ones lie in the band", _Axes(end_s, 0.01, 100.0, True),
            lambda axes: _band(axes, *_NEES_BAND) + _dots(axes, fix_t, nees, _VISION), [("fix", _VISION)],
        )  # fmt: skip
    if judged.flown.frames:
        frame_t = np.array([frame.t_s for frame in judged.flown.frames])
        latency = np.array([(frame.ready_s - frame.t_s) * 1e3 for frame in judged.flown.frames])
        chart(
            "Latency", "ms from mid-exposure to the outcome, simulated", _Axes(end_s, 0.0, _top(latency)),
            lambda axes: _dots(axes, frame_t, latency, _ROUTE), [("frame", _ROUTE)],
        )  # fmt: skip
        parts.append(_outcomes(judged, end_s))
    return "".join(parts)


def _top(*values: FloatArray) -> float:
    finite = np.concatenate([v[np.isfinite(v)] for v in values])
    return max(0.5, 1.1 * float(finite.max())) if len(finite) else 1.0


def _frame(judged: Judged, axes: _Axes, body: str) -> str:
    bottom = _HEIGHT - _BOTTOM
    parts = [f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}">', _events(judged, axes)]
    for value in axes.ticks():
        y = axes.y(value)
        parts.append(f'<path d="M{_LEFT} {y:.1f}H{_WIDTH - _RIGHT}" stroke="#e2e8f0"/>'
                     f'<text x="{_LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')  # fmt: skip
    parts += [body, _time_axis(axes, bottom), "</svg>"]
    return "".join(parts)


def _time_axis(axes: _Axes, bottom: float) -> str:
    step = _step(axes.end_s, 10)
    ticks = "".join(
        f'<text x="{axes.x(k * step):.1f}" y="{bottom + 16}" text-anchor="middle">{k * step:g}</text>'
        for k in range(math.floor(axes.end_s / step) + 1)
    )
    line = f'<path d="M{_LEFT} {bottom}H{_WIDTH - _RIGHT}" stroke="#64748b"/>'
    return f'{line}{ticks}<text x="2" y="{bottom + 16}">s</text>'


def _events(judged: Judged, axes: _Axes, height: float = _HEIGHT) -> str:
    parts = []
    scenario = judged.flown.scenario
    for colour, events in ((_GNSS_BAND, scenario.gnss), (_FAULT_BAND, scenario.fault)):
        for event in events:
            if event.from_s >= axes.end_s:
                continue
            left, right = axes.x(event.from_s), axes.x(min(event.until_s or axes.end_s, axes.end_s))
            parts.append(
                f'<rect x="{left:.1f}" y="{_TOP}" width="{max(right - left, 2.0):.1f}" '
                f'height="{height - _TOP - _BOTTOM}" fill="{colour}" opacity="0.55"><title>'
                f"{html.escape(str(event.kind))}</title></rect>"
            )
    return "".join(parts)


def _outcomes(judged: Judged, end_s: float) -> str:
    """A row of ticks for fixes and one for each reason."""
    frames = judged.flown.frames
    false = {id(f) for f, e in zip(frames, judged.errors, strict=True) if e is not None and e.is_false}
    rows: list[tuple[str, str, list[FlownFrame]]] = [
        ("fix", _TRUTH, [f for f in frames if isinstance(f.outcome, Fix) and id(f) not in false])
    ]
    if false:
        rows.append(("FALSE FIX", "#dc2626", [f for f in frames if id(f) in false]))
    for k, reason in enumerate(judged.result.rejections):
        mine = [f for f in frames if not isinstance(f.outcome, Fix) and str(f.outcome.reason) == reason]
        rows.append((reason, _REASONS[k % len(_REASONS)], mine))
    left, row_px = _LEFT, 20
    height = _TOP + _BOTTOM + row_px * len(rows)
    scale = (_WIDTH - left - _RIGHT) / end_s
    parts = [f'<svg viewBox="0 0 {_WIDTH} {height}" width="{_WIDTH}" height="{height}">']
    for k, (name, colour, mine) in enumerate(rows):
        y = _TOP + k * row_px
        parts.append(f'<text x="{left - 8}" y="{y + 14}" text-anchor="end">{html.escape(name)} {len(mine)}</text>')
        ticks = "".join(f"M{left + f.t_s * scale:.1f} {y + 3}v{row_px - 6}" for f in mine)
        if ticks:
            parts.append(f'<path d="{ticks}" stroke="{colour}" stroke-width="1.6"/>')
    step = _step(end_s, 10)
    bottom = height - _BOTTOM
    parts.append(f'<path d="M{left} {bottom}H{_WIDTH - _RIGHT}" stroke="#64748b"/>')
    parts += [f'<text x="{left + k * step * scale:.1f}" y="{bottom + 16}" text-anchor="middle">{k * step:g}</text>'
              for k in range(math.floor(end_s / step) + 1)]  # fmt: skip
    parts.append("</svg>")
    return "<p><b>What frames came to</b> <span class=note>by the time of exposure, s</span></p>" + "".join(parts)


def _line(axes: _Axes, t: FloatArray, values: FloatArray, colour: str, dashes: str = "") -> str:
    keep: BoolArray = np.isfinite(values)
    points = _thinned(np.stack([t[keep], values[keep]], axis=1))
    return _line_px(np.array([(axes.x(a), axes.y(b)) for a, b in points]).reshape(-1, 2), colour, 1.8, dashes)


def _dots(axes: _Axes, t: FloatArray, values: FloatArray, colour: str) -> str:
    points = _thinned(np.stack([t, values], axis=1))
    return "".join(_dot(axes.x(a), axes.y(b), colour, 2.0) for a, b in points)


def _band(axes: _Axes, low: float, high: float) -> str:
    y = axes.y(high)
    return (
        f'<rect x="{_LEFT}" y="{y:.1f}" width="{_WIDTH - _LEFT - _RIGHT}" height="{axes.y(low) - y:.1f}" '
        'fill="#bbf7d0" opacity="0.6"/>'
    )


def _thinned(points: FloatArray) -> FloatArray:
    every = max(1, math.ceil(len(points) / _MOST_POINTS))
    return points[::every]


def _line_px(points: FloatArray, colour: str, width: float, dashes: str = "") -> str:
    if len(points) < 2:
        return ""
    d = " ".join(f"{u:.1f},{v:.1f}" for u, v in _thinned(points))
    dashed = f' stroke-dasharray="{dashes}"' if dashes else ""
    return f'<polyline points="{d}" fill="none" stroke="{colour}" stroke-width="{width}"{dashed}/>'


def _dot(u: float, v: float, colour: str, radius: float) -> str:
    return f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{radius}" fill="{colour}"/>'


def _legend(entries: Sequence[tuple[str, str]]) -> str:
    spans = "".join(
        f'<span><i style="border-color:{colour}"></i>{html.escape(name)}</span>' for name, colour in entries
    )
    return f'<p class="legend">{spans}</p>'


# -- pictures ----------------------------------------------------------------


def _pictures(judged: Judged, store: MapStore) -> str:
    figures = []
    camera = judged.flown.scenario.camera.intrinsics().camera()
    for frame, errors in zip(judged.flown.frames, judged.errors, strict=True):
        if frame.picture is None:
            continue
        outcome = frame.outcome
        shown = draw.overlay(frame.picture, outcome, frame.truth, camera, "")
        shown = shown[shown.shape[0] - frame.picture.shape[0] :]
        if isinstance(outcome, Fix) and errors is not None:
            shown = np.hstack([shown, _map_side(store, outcome, shown.shape[0])])
            caption = (
                f"{frame.t_s:.1f} s: fix, {np.linalg.norm(errors.step_m):.2f} m and {errors.attitude_deg:.2f}° off, "
                f"{outcome.inliers} inliers; right: where they lie on the map"
            )
        else:
            reason = getattr(outcome, "reason", "")
            caption = f"{frame.t_s:.1f} s: refused, {reason}: {getattr(outcome, 'detail', '')}"
        scale = _THUMB_PX / shown.shape[0] * 0.75
        small = cv2.resize(shown, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        figures.append(
            f'<figure><img alt="frame at {frame.t_s:.1f} s" src="{_jpeg(np.asarray(small, dtype=np.uint8))}">'
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        )
    if not figures:
        return ""
    note = '<p class="note">Inliers by the fix red, by the truth green.</p>'
    return f"<h2>Some frames</h2>{note}{''.join(figures)}"


def _map_side(store: MapStore, fix: Fix, size_px: int) -> ImageArray:
    """A square of the map around the fix's points, with the points."""
    canvas = np.full((size_px, size_px, 3), 240, dtype=np.uint8)
    points = fix.points_map[:, :2]
    if not len(points):
        return canvas
    middle, half = np.median(points, axis=0), 0.55 * float(np.ptp(points, axis=0).max())
    west, south, east, north = store.bounds
    low, high = np.maximum(middle - half, (west, south)), np.minimum(middle + half, (east, north))
    window = store.read_colour((float(low[0]), float(low[1]), float(high[0]), float(high[1])), 2.0 * half / size_px)
    if window is None:
        return canvas
    to_px = np.array([[1.0, 0.0], [0.0, -1.0]]) * size_px / (2.0 * half)
    corner = window.grid.map_from_px(np.array([[0.0, 0.0]]))[0]
    shift = to_px @ (corner - middle) + size_px / 2
    scale = abs(window.grid.dx) * size_px / (2.0 * half)
    warp = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    canvas = np.asarray(
        cv2.warpAffine(window.rgb, warp, (size_px, size_px), canvas, cv2.INTER_LINEAR, cv2.BORDER_TRANSPARENT), np.uint8
    )
    for u, v in (points[:: max(1, len(points) // 300)] - middle) @ to_px.T + size_px / 2:
        cv2.circle(canvas, (round(float(u)), round(float(v))), 2, (190, 18, 60), -1, cv2.LINE_AA)
    return canvas


def _jpeg(image: ImageArray) -> str:
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")
