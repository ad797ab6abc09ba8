"""The page's thread, and what the frame path leaves for it.

The frame path puts references down and goes on; nothing here holds a lock that it takes. If the page's thread is slow,
what it did not come to is dropped and counted.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import msgspec
import numpy as np
from msgspec import Meta, Struct

from ortholoc_edge import __version__
from ortholoc_edge.adapters.commands import Answer
from ortholoc_edge.adapters.computer import ComputerStatus
from ortholoc_edge.adapters.messages import AutopilotMessage, Command, CommandReply, SearchFor
from ortholoc_edge.adapters.page.board import Board
from ortholoc_edge.adapters.page.http import RefusedError, Request, response
from ortholoc_edge.adapters.page.marks import Drawing, ground_of
from ortholoc_edge.adapters.page.options import Listen
from ortholoc_edge.adapters.page.orthophoto import TILE_PX, Orthophoto, jpeg
from ortholoc_edge.adapters.page.server import Later, PageServer
from ortholoc_edge.clock import Clock
from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry.arrays import ImageArray
from ortholoc_edge.geometry.camera import Camera
from ortholoc_edge.geometry.rigid import Rigid3
from ortholoc_edge.pipeline.frame import Frame, VehicleState
from ortholoc_edge.pipeline.navigator import Circumstances
from ortholoc_edge.pipeline.outcome import Fix, Outcome
from ortholoc_edge.tiles.store import MapStore

logger = logging.getLogger(__name__)

_MS = 1_000_000
_INBOX = 128
# How often viewers hear of something new, and of nothing new; how often the thread looks without any.
_TELL_S, _IDLE_S = 0.2, 0.5
_QUIET_S = 1.0
_PICTURE_S = 1.0
_PICTURE_PX, _PICTURE_QUALITY = 480, 65
_BIND_AGAIN_S = 5.0
_CLOSE_WAIT_S = 3.0
_DAY_S = 86400
# As for commands from the bus; and how far commands are apart at least.
_COMMAND_WAIT_S, _COMMAND_PAUSE_S = 5.0, 1.0
_SEARCH = "/command/search"
_STATIC = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/map.js": ("map.js", "text/javascript; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
_TILE = re.compile(r"/tiles/(\d{1,2})/(\d{1,5})/(\d{1,5})\.jpg", re.ASCII)
_PICTURE = re.compile(r"/frame/(\d{1,12})\.jpg", re.ASCII)


# Leaves a command for the frame path: what it comes to. None: too much waits there already.
LeaveCommand = Callable[[Command], "Future[Answer] | None"]


class SearchHere(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the page posts: corners of a polygon, metres east and north of the scene's origin; None: everywhere."""

    corners: Annotated[tuple[tuple[float, float], ...], Meta(min_length=3, max_length=100)] | None = None


class Health(Struct, frozen=True, kw_only=True):
    """How the daemon fares, once a second.

    Attributes:
        now_ns: of the daemon's clock. tracker: of `TrackerStatus`. paused: by a command. vehicle: who answers on the
            link; trouble: why nobody does. budget_ms: wall time that a frame may take; None: any.
        rung, rungs, rate_hz: of the ladder, see `LadderMessage`; rung_why: what led to the present one.
    """

    now_ns: int
    tracker: str
    paused: bool
    autopilot: AutopilotMessage
    vehicle: str | None
    trouble: str | None
    computer: ComputerStatus
    budget_ms: float | None
    rung: int
    rungs: int
    rate_hz: float | None
    rung_why: str
    statistics: Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class _Left:
    """By the frame path."""

    outcome: Outcome
    state: VehicleState | None
    circumstances: Circumstances | None
    now_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """The last frame that was drawn: a JPEG, and what goes over it."""

    number: int
    data: bytes
    event: dict[str, Any]


class GroundPage:
    """Serves the page until it is closed. `put` and `tell` are the frame path's and return at once.

    An address that can't be had is tried again and again: the flight must not wait for it.

    Attributes:
        dropped: outcomes that the page's thread did not come to.
    """

    def __init__(
        self,
        listen: Listen,
        clock: Clock,
        store: MapStore,
        camera: Camera,
        body_from_camera: Rigid3 | None,
        about: Mapping[str, Any],
        leave: LeaveCommand | None = None,
    ) -> None:
        """
        Args:
            clock: the one of frames' stamps.
            camera, body_from_camera: as configured; None: in a gimbal.
            about: more for the page's head: ``matcher``, ``vehicle``.
            leave: called in the page's thread, must return at once; None: the page takes no commands.
        """
        self._listen, self._clock = listen, clock
        west, south, east, north = store.bounds
        origin = float(round((west + east) / 2)), float(round((south + north) / 2))
        self._drawing = Drawing(origin, camera, body_from_camera)
        self._photo = Orthophoto(store)
        self._leave = leave
        self._commanded_s: float | None = None
        # Numbers begin anew with each life of the daemon, and after a restart of the computer the clock does, too.
        self._session = f"{self._clock.now_ns():x}-{time.time_ns() // _MS:x}"
        manifest, georeference = store.pack.manifest, store.pack.georeference
        version = (store.pack.manifest_sha256 or "")[:12]
        self._origin, self._georeference = origin, georeference
        self._scene = {
            "commands": leave is not None,
            "session": self._session,
            "version": __version__,
            "pack": {"name": store.pack.path.name, "date": manifest.dop.date, "attribution": manifest.dop.attribution},
            "origin": origin,
            "crs": manifest.crs,
            "bounds": (west - origin[0], south - origin[1], east - origin[0], north - origin[1]),
            "convergence_rad": georeference.convergence_rad(georeference.anchor),
            "tiles": {"side": TILE_PX, "gsd_m": self._photo.gsd_m, "levels": self._photo.levels, "v": version},
            "camera": (camera.width, camera.height),
            **about,
        }
        folder = Path(__file__).parent / "static"
        self._files = {path: ((folder / name).read_bytes(), kind) for path, (name, kind) in _STATIC.items()}
        self._inbox: deque[_Left] = deque(maxlen=_INBOX)
        self._frame: tuple[Frame, Outcome] | None = None
        self._health: Health | None = None
        self.dropped = 0
        # From here on the thread's own.
        self._board = Board()
        self._last_fix: Fix | None = None
        self._numbers = 0
        self._pictures: deque[_Picture] = deque(maxlen=2)
        self._drawn_of = -1
        # Health and picture of the last event.
        self._told: tuple[Health | None, _Picture | None] = None, None
        self._server: PageServer | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ground-page", daemon=True)
        self._thread.start()

    # -- the frame path's ------------------------------------------------------------------------------

    def put(
        self, frame: Frame | None, outcome: Outcome, state: VehicleState | None, circumstances: Circumstances | None
    ) -> None:
        """What a frame came to; returns at once.

        Args:
            frame: its image must not change any more.
            state, circumstances: None where it was not localized.
        """
        self.dropped += len(self._inbox) == _INBOX
        self._inbox.append(_Left(outcome, state, circumstances, self._clock.now_ns()))
        if frame is not None:
            self._frame = frame, outcome

    def tell(self, health: Health) -> None:
        """How things are; returns at once."""
        self._health = health

    @property
    def address(self) -> str | None:
        """Where it is served; None while the address can't be had."""
        server = self._server
        return None if server is None else str(self._listen).rpartition(":")[0] + f":{server.port}"

    def close(self) -> None:
        """End the thread. Idempotent."""
        self._stop.set()
        self._thread.join(timeout=_CLOSE_WAIT_S)

    # -- the thread ------------------------------------------------------------------------------------

    def _run(self) -> None:
        failures = 0
        while not self._stop.is_set():
            try:
                self._server = PageServer(
                    self._listen, self._answer, frozenset() if self._leave is None else frozenset({_SEARCH})
                )
                logger.info("ground page: %s%s", self.address, "" if self._listen.token is None else " (with token)")
                failures = 0
                self._serve(self._server)
            except OSError as err:
                if failures == 0:
                    logger.warning("ground page: %s can't be had (%s); tried again", self._listen, err.strerror)
                failures += 1
            except Exception:  # a defect of the page must not end the flight; it begins anew
                logger.exception("ground page")
            finally:
                if self._server is not None:
                    self._server.close()
                self._server = None
            self._stop.wait(_BIND_AGAIN_S)

    def _serve(self, server: PageServer) -> None:
        told_s = looked_s = drawn_s = 0.0
        while not self._stop.is_set():
            server.step(_TELL_S if server.clients else _IDLE_S)
            now_s = time.monotonic()
            if now_s - looked_s < _TELL_S:
                continue
            looked_s = now_s
            is_new = self._take(server.viewers > 0)
            if not server.viewers:
                continue
            if now_s - drawn_s >= _PICTURE_S and self._draw():
                drawn_s, is_new = now_s, True
            if is_new or server.newcomers or now_s - told_s >= _QUIET_S:
                told_s = now_s
                server.tell(self._event)
                self._told = self._health, self._pictures[-1] if self._pictures else None

    def _take(self, watched: bool) -> bool:
        """Whether the frame path left anything. Only where somebody watches the newest gets what the camera sees."""
        is_new = bool(self._inbox)
        while self._inbox:
            left = self._inbox.popleft()
            outcome, was = left.outcome, left.circumstances
            if isinstance(outcome, Fix):
                self._last_fix = outcome
            ground_m = None
            if watched and not self._inbox and self._last_fix is not None:
                ground_m = ground_of(self._last_fix)
            self._board.add(
                self._drawing.mark(
                    self._numbers, outcome, ground_m,
                    prior=None if was is None else was.prior, state=left.state,
                    late_ms=(left.now_ns - outcome.stamp_ns) / _MS,
                )
            )  # fmt: skip
            self._numbers += 1
        return is_new

    def _event(self, seen: int) -> tuple[int, bytes]:
        """What is newer than a number; of -1, everything."""
        event: dict[str, Any] = {"session": self._session, "now": round(self._clock.now_ns() / _MS, 1)}
        if seen < 0:
            event["scene"], event["track"] = self._scene, self._board.track()
        event["marks"] = self._board.since(seen)
        health, picture = self._told
        if seen < 0 or self._health is not health:
            event["health"] = self._health
        if self._pictures and (seen < 0 or self._pictures[-1] is not picture):
            event["picture"] = self._pictures[-1].event
        # In JSON there is no line break that could end the event.
        return self._board.last, b"data: " + msgspec.json.encode(event) + b"\n\n"

    def _draw(self) -> bool:
        """Whether a new picture was made of the last frame."""
        taken = self._frame
        if taken is None or taken[0].stamp_ns == self._drawn_of:
            return False
        frame, outcome = taken
        self._drawn_of = frame.stamp_ns
        picture = thumbnail(frame.image)
        if picture is None:
            return False
        small, scale = picture
        number = self._pictures[-1].number + 1 if self._pictures else 0
        event = {
            "n": number,
            "t": round(frame.stamp_ns / _MS, 1),
            "size": (small.shape[1], small.shape[0]),
            "inliers": self._drawing.inliers(outcome, scale) if isinstance(outcome, Fix) else [],
            "reason": None if isinstance(outcome, Fix) else str(outcome.reason),
        }
        self._pictures.append(_Picture(number, jpeg(small, _PICTURE_QUALITY), event))
        return True

    def _command(self, request: Request) -> bytes | Later:
        """Raises: RefusedError."""
        now_s = time.monotonic()
        if self._commanded_s is not None and now_s - self._commanded_s < _COMMAND_PAUSE_S:
            raise RefusedError(503, "another command was sent a moment ago; send it again")
        self._commanded_s = now_s
        try:
            asked = msgspec.json.decode(request.body, type=SearchHere)
            polygon = None if asked.corners is None else tuple(self._lat_lon(*corner) for corner in asked.corners)
            command = msgspec.convert({"polygon": polygon}, SearchFor)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError, MapError) as error:
            return _told(False, str(error), "draw a polygon on the map")
        taken = None if self._leave is None else self._leave(command)
        if taken is None:
            return _told(False, "the frame path is busy", "send it again")
        waiting = taken

        def later() -> bytes | None:
            if waiting.done():
                if waiting.exception() is not None:
                    logger.error("a command of the page", exc_info=waiting.exception())
                    return _told(False, "it failed", "see the daemon's messages")
                reply = waiting.result()
                assert isinstance(reply, CommandReply)
                return _told(reply.accepted, reply.reason, reply.remedy)
            if time.monotonic() - now_s > _COMMAND_WAIT_S and waiting.cancel():
                return _told(False, "the frame path did not come to it", "send it again")
            return None

        return later

    def _lat_lon(self, east_m: float, north_m: float) -> tuple[float, float]:
        """Raises: MapError."""
        place = self._georeference.geodetic_from_map((self._origin[0] + east_m, self._origin[1] + north_m, 0.0))
        return place.lat_deg, place.lon_deg

    def _answer(self, request: Request) -> bytes | Later | None:
        """See `PageServer`. Raises: RefusedError."""
        head_only = request.method == "HEAD"
        path = request.path
        if request.method == "POST":
            return self._command(request)
        if path == "/events":
            if head_only:
                raise RefusedError(405, "events are read with GET")
            return None
        if path in self._files:
            body, kind = self._files[path]
            return response(200, body, kind, head_only=head_only)
        if path == "/state.json":
            _, event = self._event(-1)
            return response(200, event[len(b"data: ") : -2], "application/json", head_only=head_only)
        if (tile := _TILE.fullmatch(path)) is not None:
            level, column, row = (int(number) for number in tile.groups())
            body = self._photo.tile(level, column, row) or b""
            if body:
                return response(200, body, "image/jpeg", keep_s=_DAY_S, head_only=head_only)
        elif (asked := _PICTURE.fullmatch(path)) is not None:
            for picture in self._pictures:
                if picture.number == int(asked[1]):
                    return response(200, picture.data, "image/jpeg", head_only=head_only)
        raise RefusedError(404, "there is no such thing here")


def _told(accepted: bool, reason: str, remedy: str) -> bytes:
    reply = CommandReply(command="search", accepted=accepted, reason=reason, remedy=remedy)
    return response(200, msgspec.json.encode(reply), "application/json")


def thumbnail(image: ImageArray) -> tuple[ImageArray, float] | None:
    """A frame small enough to send, and its scale; None for what is no picture."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or not image.size:
        return None
    scale = min(1.0, _PICTURE_PX / max(image.shape[:2]))
    try:
        return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8), scale
    except cv2.error:
        return None
