"""A changed configuration file, taken over in flight as far as that may be."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgspec

from ortholoc_edge.adapters import systemd
from ortholoc_edge.adapters.commands import BusyError
from ortholoc_edge.config import Config
from ortholoc_edge.errors import ConfigError

logger = logging.getLogger(__name__)

# Tables and keys that are read anew for each frame or message, so that nothing has to be opened or built again. Others
# are what the flight was begun with: map, camera, matcher, and what an autopilot was told.
RELOADABLE = (
    "attitude",
    "bus.commands",
    "bus.image_px",
    "bus.image_rate_hz",
    "ladder",
    "localizer.gate",
    "log.level",
    "log.max_mb",
    "timing.budget_ms",
    "tracker",
    "witness",
)
_POLL_S = 0.5


@dataclass(frozen=True, slots=True)
class Plan:
    """What becomes of a changed file.

    Attributes:
        config: to be in force; the old one but for ``changed``.
        changed: keys, dotted, with what they were and are.
        refused: keys that differ and need a restart.
    """

    config: Config
    changed: dict[str, tuple[Any, Any]]
    refused: tuple[str, ...]


def plan_reload(old: Config, new: Config) -> Plan:
    """Which keys of ``new`` may take effect now.

    Raises: ConfigError where they contradict one that may not.
    """
    before, after = _flat(msgspec.to_builtins(old)), _flat(msgspec.to_builtins(new))
    differing = [key for key in after if before.get(key) != after[key]]
    changed = [key for key in differing if may_change(key)]
    mixed = msgspec.to_builtins(old)
    for key in changed:
        table = mixed
        *path, name = key.split(".")
        for part in path:
            table = table[part]
        table[name] = after[key]
    try:
        config = msgspec.convert(mixed, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{error}; restart the daemon, or change what contradicts it too") from error
    return Plan(
        config,
        {key: (before[key], after[key]) for key in changed},
        tuple(key for key in differing if not may_change(key)),
    )


def may_change(key: str) -> bool:
    """Whether a key, dotted, takes effect in flight."""
    return any(key == allowed or key.startswith(f"{allowed}.") for allowed in RELOADABLE)


def _flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in table.items():
        found |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return found


class Reloader:
    """Reads the file again whenever it is asked to, in a thread of its own: no disk holds up a frame."""

    def __init__(self, config: Config, read: Callable[[], Config], take_over: Callable[[Plan], None]) -> None:
        """
        Args:
            config: in force.
            read: the file. May raise ConfigError.
            take_over: puts a plan into force. May raise BusyError.
        """
        self._config, self._read, self._take_over = config, read, take_over
        # Its `put` may be called in a signal handler, also while the same thread is inside of it.
        self._requests: queue.SimpleQueue[None] = queue.SimpleQueue()

    def ask(self) -> None:
        """Read it again; returns at once."""
        self._requests.put(None)

    def start(self, stop: threading.Event) -> None:
        """Begin, once the daemon is ready."""
        threading.Thread(target=self._run, args=(stop,), name="reload", daemon=True).start()

    def _run(self, stop: threading.Event) -> None:
        while not stop.is_set():
            try:
                self._requests.get(timeout=_POLL_S)
            except queue.Empty:
                continue
            systemd.notify_reloading()
            try:
                self._reload()
            except Exception:  # one request; the flight goes on with what it has
                logger.exception("reload")
            finally:
                systemd.notify("READY=1")

    def _reload(self) -> None:
        try:
            plan = plan_reload(self._config, self._read())
            self._take_over(plan)
        except ConfigError as error:
            logger.error("reload: the old configuration stays in force: %s", error)
            return
        except BusyError as error:
            logger.error("reload: the old configuration stays in force: the frame path is busy: %s; try again", error)
            return
        self._config = plan.config
        for key, (was, now) in plan.changed.items():
            logger.warning("reload: %s is now %s (was %s)", key, now, was)
        for key in plan.refused:
            logger.warning("reload: %s can't change in flight; restart needed, until then the old value stays", key)
        if not plan.changed and not plan.refused:
            logger.warning("reload: nothing has changed")
