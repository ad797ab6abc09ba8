"""sd_notify: readiness, watchdog and status to systemd. Silent where systemd did not start us."""

from __future__ import annotations

import contextlib
import os
import socket
import time


def notify(state: str) -> None:
    """Send one state line (systemd's sd_notify(3)): ``READY=1``, ``WATCHDOG=1``, ``STATUS=…``, ``STOPPING=1``."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return
    # A name in the abstract namespace begins with a zero byte.
    path = "\0" + address[1:] if address[0] == "@" else address
    with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
        sock.sendto(state.encode(), path)


def notify_reloading() -> None:
    """Before a configuration is read again; ``READY=1`` follows when that is done."""
    notify(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")
