"""The ``[page]`` table, and what of it is refused."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Annotated

from msgspec import Meta, Struct

from ortholoc_edge.adapters.secret import read_secret
from ortholoc_edge.errors import ConfigError

_MAX_PORT = 65535
# A token goes into addresses and into a cookie, where other characters would have to be escaped.
_TOKEN = re.compile(rb"[A-Za-z0-9._~-]{16,256}")
_HOST = "^[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?$"


class PageOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[page]`` table.

    Attributes:
        listen: IP address and port, "127.0.0.1:8080" or "[::1]:8080". Beyond loopback ``token_file`` is required.
        token_file: file with the token that a browser must know, 16 to 256 letters, digits or ``._~-``, for nobody
            else to read; without a slash the name of a systemd credential. Not the token itself: the configuration is
            written into flight logs.
        hosts: names, besides IP addresses and localhost, under which browsers may ask for the page. Others are
            refused: a website could point its own name at the drone and read the page through a visitor's browser.
        commands: whether the page may start and narrow the search; only with ``token_file``.
    """

    enabled: bool = False
    listen: str = "127.0.0.1:8080"
    token_file: Annotated[str, Meta(min_length=1)] | None = None
    hosts: tuple[Annotated[str, Meta(pattern=_HOST)], ...] = ()
    commands: bool = False


@dataclass(frozen=True, slots=True)
class Listen:
    """Where to listen, and who may come.

    Attributes:
        address: of an interface, without brackets.
        token: None: whoever reaches the address.
    """

    address: str
    port: int
    is_ipv6: bool
    token: bytes | None
    hosts: frozenset[str]

    def __str__(self) -> str:
        return f"http://[{self.address}]:{self.port}" if self.is_ipv6 else f"http://{self.address}:{self.port}"


def refused(options: PageOptions) -> str | None:
    """Why the page can't be served so; None if it can."""
    place = _address(options.listen)
    if place is None:
        return f"{options.listen!r} is no IP address with a port; write 127.0.0.1:8080 or [::1]:8080"
    if not place[0].is_loopback and options.token_file is None:
        return (
            f"{options.listen} can be reached from other computers, and there is no token_file, so anyone there could "
            "watch the flight; write 127.0.0.1, or name a file with a token"
        )
    if options.commands and options.token_file is None:
        return "commands = true without token_file, so any program there could send them; name a file with a token"
    return None


def checked(options: PageOptions, environ: Mapping[str, str]) -> Listen:
    """What the options come to.

    Args:
        environ: for ``CREDENTIALS_DIRECTORY``.
    Raises: ConfigError for an address that is none, one beyond loopback without a token, or a token that is none.
    """
    why, place = refused(options), _address(options.listen)
    if why is not None or place is None:
        raise ConfigError(f"[page] listen: {why}")
    token = None if options.token_file is None else read_token(options.token_file, environ)
    address, port = place
    hosts = frozenset(name.lower() for name in options.hosts)
    return Listen(str(address), port, address.version == 6, token, hosts)


def _address(listen: str) -> tuple[IPv4Address | IPv6Address, int] | None:
    host, colon, port = listen.rpartition(":")
    bracketed = host.startswith("[") and host.endswith("]")
    try:
        address = ip_address(host[1:-1] if bracketed else host)
    except ValueError:
        return None
    if not colon or bracketed != (address.version == 6) or not re.fullmatch(r"\d{1,5}", port, re.ASCII):
        return None
    return (address, int(port)) if int(port) <= _MAX_PORT else None


def read_token(name: str, environ: Mapping[str, str]) -> bytes:
    """See `PageOptions.token_file`. Raises: ConfigError, as `read_secret`, or for what is no token."""
    path, content = read_secret(name, environ, "[page] token_file")
    token = content.strip()
    if not _TOKEN.fullmatch(token):
        raise ConfigError(
            f"[page] token_file: {path} has {len(token)} characters; a token is 16 to 256 letters, digits or ._~- "
            "(openssl rand -hex 16 makes one)"
        )
    return token
