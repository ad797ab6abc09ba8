"""Secrets: read from files (a path, or the name of a systemd credential), and left out of what others read."""

from __future__ import annotations

import re
import stat
from collections.abc import Mapping
from pathlib import Path

from ortholoc_edge.errors import ConfigError

LEFT_OUT = "(left out)"
# rtsp://NAME:PASSWORD@HOST, and properties of GStreamer's sources. A password may hold an @, and no / unless escaped.
_IN_ADDRESS = re.compile(r"(://)[^/\s]+@")
_AS_PROPERTY = re.compile(
    r"""\b(user-id|user-pw|proxy-id|proxy-pw|password|passwd|token|secret)(\s*=\s*)("[^"]*"|'[^']*'|\S+)"""
)
# Cameras take ?user=NAME&pwd=PASSWORD under names of their own, so nothing of a query is shown.
_IN_QUERY = re.compile(rf"""(://(?:{re.escape(LEFT_OUT)}@)?[^\s?"']*\?)[^\s"']+""")


def without_credentials(text: str) -> str:
    """An address or a GStreamer pipeline, for others to read."""
    return _AS_PROPERTY.sub(
        rf"\1\2{LEFT_OUT}", _IN_QUERY.sub(rf"\1{LEFT_OUT}", _IN_ADDRESS.sub(rf"\1{LEFT_OUT}@", text))
    )


def read_secret(name: str, environ: Mapping[str, str], key: str) -> tuple[Path, bytes]:
    """A secret, and the file that it is in.

    Args:
        name: a path, or without a slash the name of a systemd credential (LoadCredential=).
        environ: for ``CREDENTIALS_DIRECTORY``.
        key: of the configuration, "[link] signing_key" say, for messages.
    Raises: ConfigError that says what is wrong with it, and never what is in it.
    """
    if "/" in name:
        path = Path(name)
    elif "CREDENTIALS_DIRECTORY" in environ:
        path = Path(environ["CREDENTIALS_DIRECTORY"]) / name
    else:
        raise ConfigError(
            f"{key}: {name!r} names a systemd credential, but there is no CREDENTIALS_DIRECTORY; write "
            f"LoadCredential={name}:/path/to/key into the unit, or a path with a slash here"
        )
    try:
        mode, content = path.stat().st_mode, path.read_bytes()
    except OSError as error:
        raise ConfigError(
            f"{key}: {path} can't be read: {error.strerror}; name a file that the user of this program "
            "owns, with mode 600, or a systemd credential"
        ) from error
    # A credential of systemd's shows the mask of its access list where other files have their group's bits.
    others = stat.S_IROTH | stat.S_IWOTH | (stat.S_IRGRP | stat.S_IWGRP if "/" in name else 0)
    if mode & others:
        raise ConfigError(
            f"{key}: others than its owner may read or write {path} (mode {stat.S_IMODE(mode):o}), so it "
            "is no secret; make a new one, and chmod 600 it"
        )
    return path, content
