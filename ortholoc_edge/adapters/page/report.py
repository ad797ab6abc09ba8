"""A flight that is over as one HTML file that needs nothing else: the page's map, drawn by the same script."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from msgspec import Struct

from ortholoc_edge.adapters.page.ground_page import thumbnail
from ortholoc_edge.adapters.page.marks import Drawing, Mark, Point, ground_of
from ortholoc_edge.adapters.page.orthophoto import Orthophoto, jpeg
from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import VehicleState
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.pipeline.prior import PosePrior
from ortholoc_edge.tiles.store import MapStore

_STATIC = Path(__file__).parent / "static"
_MAP_PX, _MAP_QUALITY, _MARGIN_M = 1400, 72, 60.0
_PICTURE_QUALITY = 60
# 10 to 20 KB each.
MOST_PICTURES = 40
# 0.7 KB each; of a longer flight every second, third, and so on is shown.
_MOST_FRAMES = 2000
# Nothing is loaded from anywhere.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
_BODY = """<main>
<section id="map-part">
<canvas id="map" tabindex="0" role="img" aria-label="map with the flight"></canvas>
<div id="map-buttons">
<button type="button" id="zoom-in" aria-label="zoom in">+</button>
<button type="button" id="zoom-out" aria-label="zoom out">&minus;</button>
<button type="button" id="follow" aria-pressed="false">follow</button>
<button type="button" id="whole">all</button>
</div>
<ul id="legend"></ul>
</section>
<section>
<div id="pick"><button type="button" id="before" aria-label="frame before">&#9664;</button>
<input type="range" id="slider" min="0" value="0" aria-label="frame">
<button type="button" id="after" aria-label="next frame">&#9654;</button></div>
<div id="name"></div><div id="what"></div>
<canvas id="frame" role="img" aria-label="the frame with its matches"></canvas>
<p class="hint" id="no-picture" hidden>The picture of this frame is not in the report, which keeps some.</p>
</section>
<section><h2>Over the frames <span class="unit">m: error green, 1 &sigma; violet; red: no fix</span></h2>
<canvas id="chart"></canvas></section>
<section><h2>Figures</h2><pre>SUMMARY</pre></section>
</main>"""


class Picture(Struct, frozen=True):
    """A small frame: its JPEG as a data URL, width and height, and `Drawing.inliers`."""

    src: str
    size: tuple[int, int]
    inliers: list[tuple[float, float, float, float, float, float]]


class ShownFrame(Struct, frozen=True, kw_only=True):
    """One frame. ``error``: m and degrees off the truth, where both are known."""

    name: str
    mark: Mark
    truth: Point | None
    error: tuple[float, float] | None
    picture: Picture | None


@dataclass(slots=True, eq=False)
class FlightRecord:
    """Collects the frames of a flight as they come.

    Args:
        drawing: its origin is the report's.
    """

    drawing: Drawing
    frames: list[ShownFrame]
    # Of frames whose picture is kept: every second, fourth and so on as the flight grows.
    every: int = 1
    ground_m: float | None = None

    @classmethod
    def over(cls, store: MapStore, camera: Camera, body_from_camera: Rigid3 | None = None) -> FlightRecord:
        """Of a flight over a pack."""
        west, south, east, north = store.bounds
        origin = float(round((west + east) / 2)), float(round((south + north) / 2))
        return cls(Drawing(origin, camera, body_from_camera), [])

    def add(
        self, name: str, outcome: Outcome, *, prior: PosePrior | None, image: ImageArray | None,
        truth: Rigid3 | None = None, error: tuple[float, float] | None = None, state: VehicleState | None = None,
        ground_m: float | None = None,
    ) -> None:  # fmt: skip
        """
        Args:
            image: of all frames, of which some are kept.
            ground_m: height of the ground, of fixes whose points are not known.
        """
        if isinstance(outcome, Fix):
            seen = ground_of(outcome)
            self.ground_m = ground_m if seen is None else seen
        mark = self.drawing.mark(len(self.frames), outcome, self.ground_m, prior=prior, state=state)
        at = None
        if truth is not None:
            east, north = (truth.translation[:2] - self.drawing.origin).tolist()
            at = round(east, 2), round(north, 2)
        picture = None if len(self.frames) % self.every else self._picture(image, outcome)
        self.frames.append(ShownFrame(name=name, mark=mark, truth=at, error=error, picture=picture))
        if len(self.frames) > MOST_PICTURES * self.every:
            self.every *= 2
            self.frames = [
                frame if k % self.every == 0 or frame.picture is None else msgspec.structs.replace(frame, picture=None)
                for k, frame in enumerate(self.frames)
            ]

    def _picture(self, image: ImageArray | None, outcome: Outcome) -> Picture | None:
        small = None if image is None else thumbnail(image)
        if small is None:
            return None
        inliers = self.drawing.inliers(outcome, small[1]) if isinstance(outcome, Fix) else []
        return Picture(_data_url(jpeg(small[0], _PICTURE_QUALITY)), (small[0].shape[1], small[0].shape[0]), inliers)

    def page(self, store: MapStore, title: str, notes: Sequence[str], summary: str) -> str | None:
        """The report; None where no frame lies on the map.

        Args:
            summary: text, as it is to stand there.
        """
        picture = self._map(store)
        if picture is None or not self.frames:
            return None
        every = math.ceil(len(self.frames) / _MOST_FRAMES)
        if every > 1:
            notes = [*notes, f"Of {len(self.frames)} frames one in {every} is shown."]
        georeference = store.pack.georeference
        data = msgspec.json.encode(
            {
                "frames": self.frames[::every],
                "map": picture,
                "convergence_rad": georeference.convergence_rad(georeference.anchor),
            }
        ).decode()
        script = "\n".join((_STATIC / name).read_text(encoding="utf-8") for name in ("map.js", "report.js"))
        style = (_STATIC / "page.css").read_text(encoding="utf-8")
        # A slash after "<" would end the element that holds the data.
        return (
            f'<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
            f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{style}</style></head>'
            f'<body class="report"><h1>{html.escape(title)}</h1>'
            + "".join(f"<p>{html.escape(note)}</p>" for note in notes)
            + _BODY.replace("SUMMARY", html.escape(summary))
            + f'<script type="application/json" id="data">{data.replace("<", chr(92) + "u003c")}</script>'
            + f"<script>{script}</script></body></html>\n"
        )

    def _map(self, store: MapStore) -> dict[str, object] | None:
        """The part of the orthophoto that was flown over, not larger than `_MAP_PX`."""
        poses = [pose for frame in self.frames for pose in (frame.mark.fix, frame.mark.prior) if pose is not None]
        places = [pose.at[:2] for pose in poses] + [frame.truth for frame in self.frames if frame.truth is not None]
        places += [point for pose in poses for point in pose.rim]
        if not places:
            return None
        low, high = np.min(places, axis=0) - _MARGIN_M, np.max(places, axis=0) + _MARGIN_M
        west, south, east, north = store.bounds
        low = np.maximum(low + self.drawing.origin, (west, south))
        high = np.minimum(high + self.drawing.origin, (east, north))
        if not (high - low > 1.0).all():
            return None
        gsd_m = max(float((high - low).max()) / _MAP_PX, store.dop_grids[0].gsd_m)
        width, height = (max(1, math.ceil(side)) for side in ((high - low) / gsd_m).tolist())
        bounds = float(low[0]), float(high[1]) - height * gsd_m, float(low[0]) + width * gsd_m, float(high[1])
        try:
            image = Orthophoto(store).draw(bounds, width, height)
        except MapError:
            return None
        e, n = self.drawing.origin
        return {
            "src": _data_url(jpeg(image, _MAP_QUALITY)),
            "bounds": (bounds[0] - e, bounds[1] - n, bounds[2] - e, bounds[3] - n),
        }


def _data_url(data: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(data).decode("ascii")
