"""As much of HTTP/1.1 as the page needs: GET and HEAD without a body, POST of JSON to what takes
commands, one request per connection; bytes in, bytes out.

Own, and not the library's: `http.server` takes a thread for each connection, and asyncio loads TLS. What is not
understood is refused, so that there is little to get wrong: no chunks, no second request that a first could
smuggle in.
"""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Mapping
from dataclasses import dataclass
from ipaddress import ip_address
from urllib.parse import parse_qs

MAX_HEAD_BYTES, MAX_BODY_BYTES = 8192, 8192
_MAX_HEADERS = 64
_REQUEST_LINE = re.compile(rb"([A-Z]{1,16}) (/[\x21-\x7e]{0,1023}) HTTP/1\.[01]")
# One quantifier after the colon and no more: beside it others for blanks took minutes over 8 KiB of them.
_HEADER = re.compile(rb"([!#$%&'*+.^_`|~0-9A-Za-z-]{1,64}):([\x20-\x7e\x80-\xff\t]*)")
_HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9.-]+)(:\d{1,5})?", re.ASCII)
_STATUS = {
    200: "OK", 303: "See Other", 400: "Bad Request", 401: "Unauthorized", 403: "Forbidden", 404: "Not Found",
    405: "Method Not Allowed", 408: "Request Timeout", 413: "Content Too Large",
    415: "Unsupported Media Type", 431: "Request Header Fields Too Large", 500: "Internal Server Error",
    503: "Service Unavailable",
}  # fmt: skip
# Only what we serve ourselves is loaded, shown, or framed; and nothing of ours by other sites.
_SECURITY = (
    "Content-Security-Policy: default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'\r\n"
    "X-Content-Type-Options: nosniff\r\n"
    "X-Frame-Options: DENY\r\n"
    "Referrer-Policy: no-referrer\r\n"
    "Cross-Origin-Resource-Policy: same-origin\r\n"
    "Cross-Origin-Opener-Policy: same-origin\r\n"
)
_COOKIE = "ortholoc_page"
_ASK = b"""<!DOCTYPE html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>OrthoLoC</title><link rel="stylesheet" href="/page.css"><main class="ask"><h1>OrthoLoC</h1>
<p>This page asks for its token: that of <code>token_file</code> on the drone.</p>
<form action="/" method="get"><input name="token" type="password" aria-label="token" autocomplete="off" required>
<button>Open</button></form></main></html>
"""


class RefusedError(Exception):
    """A request that gets no more than a status."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status, self.why = status, why


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for; ``headers`` by lower-case name, ``body_bytes`` as announced."""

    method: str
    path: str
    query: str
    headers: Mapping[str, str]
    body_bytes: int = 0
    body: bytes = b""


def parse_request(head: bytes, posts: frozenset[str] = frozenset()) -> Request:
    """A request's head, up to the empty line that ends it.

    Args:
        posts: paths that take a body.
    Raises: RefusedError.
    """
    line, *rest = head.split(b"\r\n")
    match = _REQUEST_LINE.fullmatch(line)
    if match is None:
        raise RefusedError(400, "not a request of HTTP/1.1")
    if len(rest) > _MAX_HEADERS:
        raise RefusedError(431, "too many headers")
    headers: dict[str, str] = {}
    for text in rest:
        header = _HEADER.fullmatch(text)
        if header is None:
            raise RefusedError(400, "a header that is none")
        name = header[1].decode("ascii").lower()
        if name in headers and name in ("host", "origin", "content-length", "transfer-encoding", "cookie"):
            raise RefusedError(400, f"{name} twice")
        headers[name] = header[2].strip(b" \t").decode("latin-1")
    path, _, query = match[2].decode("ascii").partition("?")
    if match[1] == b"POST" and path in posts:
        return Request("POST", path, query, headers, _posted_bytes(headers))
    if match[1] not in (b"GET", b"HEAD"):
        raise RefusedError(405, "the page is only read")
    if path in posts:
        raise RefusedError(405, "commands are sent with POST")
    if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
        raise RefusedError(413, "no body is taken here")
    return Request(match[1].decode("ascii"), path, query, headers)


def _posted_bytes(headers: Mapping[str, str]) -> int:
    """Raises: RefusedError."""
    # A form of another site can send neither this type nor, from a script, without asking first.
    if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise RefusedError(415, "commands are JSON")
    # Who posts says where from: a browser does.
    if "origin" not in headers:
        raise RefusedError(403, "a command without an origin")
    length = headers.get("content-length", "")
    if "transfer-encoding" in headers or not re.fullmatch(r"\d{1,5}", length, re.ASCII):
        raise RefusedError(400, "a body without a length")
    if int(length) > MAX_BODY_BYTES:
        raise RefusedError(413, f"a body of more than {MAX_BODY_BYTES} bytes")
    return int(length)


def response(
    status: int, body: bytes = b"", content_type: str = "text/plain; charset=utf-8", *, extra: str = "",
    keep_s: int = 0, head_only: bool = False,
) -> bytes:  # fmt: skip
    """A whole answer.

    Args:
        extra: more header lines, each ended by CR LF.
        keep_s: how long the browser may keep it; by default it may not.
    """
    caching = f"private, max-age={keep_s}, immutable" if keep_s else "no-store"
    head = (
        f"HTTP/1.1 {status} {_STATUS[status]}\r\n"
        f"Content-Type: {content_type}\r\n"
        f"Content-Length: {len(body)}\r\n"
        f"Cache-Control: {caching}\r\n"
        f"Connection: close\r\n{_SECURITY}{extra}\r\n"
    )
    return head.encode("latin-1") + (b"" if head_only else body)


def stream_head() -> bytes:
    """The head of an answer that goes on: server-sent events. The browser tries again a second after it ended."""
    return (
        "HTTP/1.1 200 OK\r\nContent-Type: text/event-stream; charset=utf-8\r\nCache-Control: no-store\r\n"
        f"X-Accel-Buffering: no\r\nConnection: close\r\n{_SECURITY}\r\nretry: 1000\n\n"
    ).encode("latin-1")


class Guard:
    """Who may ask. Without a token whoever reaches the socket, but never through another site's page."""

    def __init__(self, token: bytes | None, hosts: frozenset[str] = frozenset()) -> None:
        """
        Args:
            token: that a browser must show once, as ``?token=``; then it has a cookie.
            hosts: names that the page is asked for by, besides addresses and localhost; lower case.
        """
        self._token, self._hosts = token, hosts
        # A browser shows a cookie to every port of the host: not the token itself, that may be used elsewhere.
        self._cookie = None if token is None else hashlib.sha256(b"ortholoc page\0" + token).hexdigest()

    def answer(self, request: Request) -> bytes | None:
        """An answer to what may not be asked, or to a token; None: go on. Raises: RefusedError."""
        host = request.headers.get("host", "")
        if not self._is_ours(host):
            raise RefusedError(403, f"asked for as {host[:80]!r}; name it in [page] hosts")
        origin = request.headers.get("origin")
        if origin is not None and origin.lower() != f"http://{host.lower()}":
            raise RefusedError(403, "asked for by another site")
        site = request.headers.get("sec-fetch-site", "none")
        # Anyone may link to the page, nobody may build its parts into theirs.
        if site not in ("none", "same-origin") and request.headers.get("sec-fetch-mode") != "navigate":
            raise RefusedError(403, "asked for by another site")
        if self._token is None or self._cookie is None:
            return None
        if request.path == "/" and "token" in (asked := parse_qs(request.query)):
            if hmac.compare_digest(asked["token"][0].encode("utf-8"), self._token):
                # Lax: the redirect after a link in a message must carry it; a command of another site gets none.
                cookie = f"{_COOKIE}={self._cookie}; Path=/; HttpOnly; SameSite=Lax; Max-Age=86400"
                return response(303, extra=f"Location: /\r\nSet-Cookie: {cookie}\r\n")
            return self._ask(request)
        shown = _cookie_of(request.headers.get("cookie", ""))
        if shown is not None and hmac.compare_digest(shown.encode("latin-1"), self._cookie.encode("ascii")):
            return None
        # The form that asks has to look like something, and its style tells nothing.
        return None if request.path == "/page.css" else self._ask(request)

    def _ask(self, request: Request) -> bytes:
        return response(401, _ASK, "text/html; charset=utf-8", head_only=request.method == "HEAD")

    def _is_ours(self, host: str) -> bool:
        """Whether the name is an address, which nobody can point elsewhere, or one of ours."""
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = match[1].lower()
        if name == "localhost" or name in self._hosts:
            return True
        try:
            return (ip_address(name.strip("[]")).version == 6) == name.startswith("[")
        except ValueError:
            return False


def _cookie_of(header: str) -> str | None:
    for part in header.split(";"):
        name, _, value = part.strip().partition("=")
        if name == _COOKIE:
            return value
    return None
