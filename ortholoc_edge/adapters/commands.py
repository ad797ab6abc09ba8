"""Commands from the bus: bytes of strangers to checked values, and their way to the thread that owns the flight.

Whoever asks waits for the frame path, never the other way round: the frame path looks between two frames whether a
command waits, and one that it did not come to in time is withdrawn, so that no command that was told refused is
carried out later.
"""

from __future__ import annotations

import queue
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

import msgspec

from ortholoc_edge.adapters.messages import COMMANDS, JSON, MSGPACK, Command, CommandReply

T = TypeVar("T")

# The largest command is a polygon of 100 corners: 4 KB as JSON with all digits, twice that where it is indented.
MOST_BYTES = 16384
_MOST_WAITING = 4
# As zenoh says that nothing was said.
_UNSAID = ("", "zenoh/bytes", "text/json", "zenoh/string", "text/plain")


class CommandError(Exception):
    """A command that can't be read; ``reply`` says why."""

    def __init__(self, name: str, reason: str, remedy: str) -> None:
        super().__init__(reason)
        self.reply = CommandReply(command=name, accepted=False, reason=reason, remedy=remedy)


def parse_command(name: str, payload: bytes, encoding: str, vehicle: str) -> Command:
    """
    Args:
        name: the key's last part.
        payload: may be anything.
        encoding: as the sender named it; taken for JSON where it named none.
        vehicle: ours.
    Raises: CommandError.
    """
    kind = COMMANDS.get(name)
    if kind is None:
        raise CommandError(name[:64], f"{name[:64]!r} is no command", f"send one of {', '.join(COMMANDS)}")
    if len(payload) > MOST_BYTES:
        raise CommandError(
            name, f"payload of {len(payload)} bytes, {MOST_BYTES} are allowed", "send the command's fields alone"
        )
    form = encoding.partition(";")[0]
    command: Command
    try:
        if not payload:
            command = msgspec.convert({}, kind)
        elif form == MSGPACK:
            command = msgspec.msgpack.decode(payload, type=kind)
        elif form == JSON or form in _UNSAID:
            command = msgspec.json.decode(payload, type=kind)
        else:
            raise CommandError(name, f"encoding {form[:64]!r} is not understood", f"send {JSON} or {MSGPACK}")
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise CommandError(
            name, f"payload is no {kind.__name__}: {error}", "see `ortholoc-edge bus schema` for its fields"
        ) from error
    if command.vehicle is not None and command.vehicle != vehicle:
        raise CommandError(
            name, f"meant for {command.vehicle[:64]!r}, this is {vehicle!r}", "ask under that vehicle's key"
        )
    return command


# A reply, or what remains to be done for it away from the frame path: writing a file.
Answer = CommandReply | Callable[[], CommandReply]


class BusyError(Exception):
    """The frame path did not come to a task in time; it will not be done."""


class Desk:
    """Where other threads leave tasks for the one that owns the flight, and wait for what they come to."""

    def __init__(self) -> None:
        self._waiting: queue.Queue[tuple[Callable[[], Any], Future[Any]]] = queue.Queue(_MOST_WAITING)

    def leave(self, task: Callable[[], T]) -> Future[T] | None:
        """Have it done, and go on: what it comes to. Who gives it up cancels that. None: too many wait already."""
        future: Future[T] = Future()
        try:
            self._waiting.put_nowait((task, future))
        except queue.Full:
            return None
        return future

    def ask(self, task: Callable[[], T], timeout_s: float) -> T:
        """What ``task`` returns, done by the thread that serves.

        Raises: BusyError if it was not begun in time, and what it raised.
        """
        future = self.leave(task)
        if future is None:
            raise BusyError(f"{_MOST_WAITING} tasks wait already")
        try:
            return future.result(timeout_s)
        except TimeoutError:
            if future.cancel():
                raise BusyError(f"not begun within {timeout_s:g} s") from None
            # It was begun, and takes microseconds: where that hangs, the watchdog ends the process.
            return future.result()

    def serve(self) -> None:
        """Do what waits. Called by the owner, between two frames."""
        while True:
            try:
                task, future = self._waiting.get_nowait()
            except queue.Empty:
                return
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(task())
            except Exception as error:  # told to whoever asked; the flight goes on
                future.set_exception(error)
