"""Commands carried out by the thread that owns the flight, between two frames."""

from __future__ import annotations

import contextlib
import datetime
import logging
import math
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import msgspec
import numpy as np

from ortholoc_edge.adapters.commands import Answer
from ortholoc_edge.adapters.flight_log import FlightLog, LoggedStep
from ortholoc_edge.adapters.mavlink import AutopilotLink, GivenPlace, Severity
from ortholoc_edge.adapters.messages import (
    Command,
    CommandReply,
    Pause,
    Relocalize,
    Resume,
    SearchFor,
    SetPrior,
    Statistic,
)
from ortholoc_edge.clock import Clock, wall_clock_ns
from ortholoc_edge.errors import MapError
from ortholoc_edge.geometry import polygon
from ortholoc_edge.geometry.arrays import FloatArray, ImageArray
from ortholoc_edge.pipeline.frame import Frame
from ortholoc_edge.pipeline.navigator import Navigator
from ortholoc_edge.pipeline.outcome import Outcome
from ortholoc_edge.pipeline.record import frame_record, outcome_record
from ortholoc_edge.pipeline.tracker import GivenPosition, StartAnew
from ortholoc_edge.tiles.store import MapStore

logger = logging.getLogger(__name__)

_S = 1_000_000_000
# Of a megabyte or less each: who needs more wants a flight log with all frames.
_MOST_SNAPSHOTS = 100
# For a typical height of the ground.
_GROUND_GSD_M = 4.0
# A polygon that reaches further beyond the pack is a slip: latitude and longitude swapped, a digit lost.
_FURTHEST_M = 100_000.0
# Less is no area for a vehicle.
_LEAST_AREA_M2 = 1.0
# Of a height that the autopilot believes, its barometer's drift and a wrong origin included; and at least of one
# that somebody gave.
_HEIGHT_SIGMA_M = 30.0
# Of `SetPrior`.
_MOST_SIGMA_M = 500.0


class Commander:
    """Used by one thread, but for what it leaves to be done elsewhere.

    Attributes:
        paused: whether frames are left alone.
        lost_sigma_m: horizontal 1-sigma beyond which the tracker predicts nothing.
    """

    def __init__(
        self,
        navigator: Navigator,
        store: MapStore,
        link: AutopilotLink,
        clock: Clock,
        counts: Counter[str],
        statistics: Callable[[], dict[str, Statistic]],
        *,
        lost_sigma_m: float,
        log: FlightLog | None,
        snapshots: Path | None,
        search_in: Callable[[FloatArray | None, int], None] | None,
    ) -> None:
        """
        Args:
            counts: of the owner, to which ``commands`` is added.
            snapshots: folder for them; None: nowhere.
            search_in: has the map searched at once, inside of corners (N, 2) of the map or everywhere (None), at a
                time of the clock; None: it is not searched at all.
        """
        self._navigator, self._store, self._link, self._clock = navigator, store, link, clock
        self._counts, self._statistics = counts, statistics
        self._log, self._snapshots, self._search_in = log, snapshots, search_in
        self._last: tuple[Frame, Outcome, LoggedStep | None] | None = None
        self.lost_sigma_m = lost_sigma_m
        self.paused = False

    def note(self, frame: Frame, outcome: Outcome, step: LoggedStep | None) -> None:
        """What a snapshot would show from now on."""
        self._last = frame, outcome, step

    def carry_out(self, command: Command) -> Answer:
        """Do it, and say what came of it."""
        now_ns = self._clock.now_ns()
        answer: Answer
        match command:
            case Relocalize():
                answer = self._relocalize(command, now_ns)
            case SetPrior():
                answer = self._set_prior(command, now_ns)
            case SearchFor():
                answer = self._search(command, now_ns)
            case Pause():
                answer = self._pause(paused=True)
            case Resume():
                answer = self._pause(paused=False)
            case _:
                answer = self._snapshot(now_ns)
        self._counts["commands"] += 1
        said = answer if isinstance(answer, CommandReply) else CommandReply(command="snapshot", accepted=True)
        if said.accepted:
            logger.warning("command %s carried out: %s", said.command, command)
            self._link.send_status_text(Severity.NOTICE, f"OrthoLoC: {said.command} by command")
        if self._log is not None:
            self._log.command(now_ns, command, said)
        return answer

    def take_place(self, place: GivenPlace) -> bool:
        """A position by MAVLink, as `SetPrior`: whether it is taken; why not is told as a text."""
        reply = self._placed(place)
        if not reply.accepted:
            logger.warning("position by MAVLink refused: %s; %s", reply.reason, reply.remedy)
            self._link.send_status_text(Severity.WARNING, f"OrthoLoC: position refused: {reply.reason}")
        return reply.accepted

    def _placed(self, place: GivenPlace) -> CommandReply:
        state = self._link.state_at(self._clock.now_ns())
        height_m, speed_m_s = place.height_amsl_m, 0.0
        if state is not None and state.velocity_ned is not None:
            speed_m_s = float(np.hypot(*state.velocity_ned[:2]))
        # What is believed aboard comes first: an operator sees a place on a map, and rarely a height.
        if state is not None and state.origin is not None and state.local_position_ned_m is not None:
            height_m = state.origin.height_amsl_m - float(state.local_position_ned_m[2])
        if height_m is None:
            return _refused("set_prior", "the autopilot tells no height", "send one, above mean sea level")
        if place.sigma_m is None:
            sigma_m = min(_MOST_SIGMA_M, self.lost_sigma_m)
        else:
            # Whichever way it flew since.
            sigma_m = math.hypot(place.sigma_m, speed_m_s * place.age_s)
        try:
            command = msgspec.convert(
                {
                    "lat_deg": place.lat_deg,
                    "lon_deg": place.lon_deg,
                    "height_amsl_m": height_m,
                    "sigma_horizontal_m": max(1.0, sigma_m),
                    "sigma_vertical_m": _HEIGHT_SIGMA_M,
                },
                SetPrior,
            )
        except msgspec.ValidationError as error:
            return _refused("set_prior", str(error), "send a position of this vehicle")
        reply = self.carry_out(command)
        assert isinstance(reply, CommandReply)
        return reply

    def _relocalize(self, command: Relocalize, now_ns: int) -> CommandReply:
        if not (self._navigator.tracker.witness.trusted or command.trust_gnss):
            return _refused(
                "relocalize",
                "GNSS contradicts the fixes, so without them nothing says where to look",
                "send set_prior, or relocalize with trust_gnss = true if it is the fixes that are wrong",
            )
        self._navigator.give(StartAnew(stamp_ns=now_ns, trust_gnss=command.trust_gnss))
        return CommandReply(command="relocalize", accepted=True)

    def _set_prior(self, command: SetPrior, now_ns: int) -> CommandReply:
        if command.sigma_horizontal_m > self.lost_sigma_m:
            return _refused(
                "set_prior",
                f"sigma_horizontal_m is {command.sigma_horizontal_m:g}, up to {self.lost_sigma_m:g} m is searched",
                "send a narrower one, or raise [tracker] lost_sigma_m",
            )
        try:
            x, y, z = self._store.pack.georeference.map_from_geodetic(
                command.lat_deg, command.lon_deg, height_amsl_m=command.height_amsl_m
            ).tolist()
        except MapError as error:
            return _refused("set_prior", str(error), "send a position inside the pack")
        west, south, east, north = self._store.bounds
        outside_m = max(west - x, x - east, south - y, y - north)
        if outside_m > 0.0:
            return _refused("set_prior", f"the position is {outside_m:.0f} m outside of the pack", "send one inside")
        ground_m = self._store.ground_near((x, y), _GROUND_GSD_M)
        if ground_m is not None and z < ground_m - 3.0 * command.sigma_vertical_m:
            return _refused(
                "set_prior",
                f"height_amsl_m is {command.height_amsl_m:g}, {ground_m - z:.0f} m below the ground there",
                "send the height above mean sea level, not above the ground; or a larger sigma_vertical_m",
            )
        self._navigator.give(
            GivenPosition(
                stamp_ns=now_ns,
                position_map_m=(x, y, z),
                sigma_m=(command.sigma_horizontal_m, command.sigma_vertical_m),
            )
        )
        return CommandReply(command="set_prior", accepted=True)

    def _search(self, command: SearchFor, now_ns: int) -> CommandReply:
        if self._search_in is None:
            return _refused(
                "search",
                "this vehicle does not search the map",
                "set [search] enabled = true and restart it, or send set_prior",
            )
        corners = None
        if command.polygon is not None:
            try:
                corners = polygon.without_repeats(self._store.pack.georeference.map_from_lat_lon(command.polygon))
            except MapError as error:
                return _refused("search", str(error), "send a polygon that overlaps the pack")
            reason = _why_not(corners, self._store.bounds)
            if reason is not None:
                return _refused("search", *reason)
        self._search_in(corners, now_ns)
        return CommandReply(command="search", accepted=True)

    def _pause(self, *, paused: bool) -> CommandReply:
        name = "pause" if paused else "resume"
        if self.paused == paused:
            return _refused(name, "the daemon is paused already" if paused else "the daemon is not paused", "nothing")
        self.paused = paused
        return CommandReply(command=name, accepted=True)

    def _snapshot(self, now_ns: int) -> Answer:
        if self._last is None:
            return _refused("snapshot", "no frame has come yet", "ask again when there is a picture")
        if self._snapshots is None:
            return _refused("snapshot", "there is no folder for it", "set [log] folder in the configuration")
        frame, outcome, step = self._last
        content = msgspec.json.encode(
            {
                "stamp_ns": frame.stamp_ns,
                "age_ms": (now_ns - frame.stamp_ns) / 1e6,
                "name": frame.name,
                "outcome": outcome_record(outcome),
                "step": None if step is None else frame_record(frame.name, frame.exposure_ns, True, *step),
                "statistics": self._statistics(),
            }
        )
        folder = self._snapshots
        return lambda: _write_snapshot(folder, frame.image, content)


def _write_snapshot(folder: Path, image: ImageArray, content: bytes) -> CommandReply:
    """Away from the frame path, since a disk may hang."""
    now = datetime.datetime.fromtimestamp(wall_clock_ns() / _S, datetime.UTC)
    stem = f"snapshot-{now.strftime('%Y%m%dT%H%M%S.%f')[:-3]}Z"
    picture = folder / f"{stem}.png"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if sum(1 for _ in folder.glob("snapshot-*.json")) >= _MOST_SNAPSHOTS:
            return _refused("snapshot", f"{folder} has {_MOST_SNAPSHOTS} snapshots", "remove some of them")
        drawn = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        _written(picture, cv2.imencode(".png", drawn)[1].tobytes())
        # Last: where it is, the picture is whole.
        _written(folder / f"{stem}.json", content)
    except (OSError, cv2.error) as error:
        with contextlib.suppress(OSError):
            picture.unlink(missing_ok=True)
        return _refused("snapshot", f"{folder}: can't be written ({error})", "make room, or see [log] folder")
    return CommandReply(command="snapshot", accepted=True, path=str(picture))


def _written(path: Path, data: bytes) -> None:
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.rename(path)
    except OSError:
        # Of a disk that it filled.
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def _why_not(corners: FloatArray, bounds: tuple[float, float, float, float]) -> tuple[str, str] | None:
    """Reason and remedy why a polygon (N, 2), m, can't be searched in the map's box; None if it can."""
    if len(corners) < 3:
        return f"the polygon has {len(corners)} different corners", "send three or more"
    west, south, east, north = bounds
    beyond_m = float(np.max((west, south) - corners)), float(np.max(corners - (east, north)))
    if max(beyond_m) > _FURTHEST_M:
        return (
            f"the polygon reaches {max(beyond_m) / 1e3:.0f} km beyond the pack",
            "send corners as (latitude, longitude), near the pack",
        )
    if polygon.crosses_itself(corners):
        return "the polygon's sides cross or touch", "send its corners in order, once around"
    if polygon.area(corners) < _LEAST_AREA_M2:
        return "the polygon has no area", "send a wider one"
    if polygon.area(polygon.clipped(corners, bounds)) < _LEAST_AREA_M2:
        return "the polygon is outside of the pack", "send one that overlaps it"
    return None


def _refused(command: str, reason: str, remedy: str) -> CommandReply:
    return CommandReply(command=command, accepted=False, reason=reason, remedy=remedy)
