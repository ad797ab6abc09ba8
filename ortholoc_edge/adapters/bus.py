"""The daemon on zenoh, under ``ortholoc/<vehicle>/``; payloads are those of `messages`.

fix, rejection, state, health, autopilot    published; a get is answered with the latest
image                                       JPEG, small, at a rate of its own; off by default
config, stats                               answer a get
command/NAME                                answer a get with payload; refused unless ``commands`` is set
alive                                       liveliness token
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta, Struct, field

from ortholoc_edge.adapters.commands import Answer, CommandError, parse_command
from ortholoc_edge.adapters.messages import (
    ASKED,
    JSON,
    MSGPACK,
    PUBLISHED,
    Command,
    CommandReply,
    Published,
)
from ortholoc_edge.errors import ConfigError, LinkError
from ortholoc_edge.geometry.arrays import ImageArray

if TYPE_CHECKING:
    import zenoh  # 4 MB, so where the bus is off it is not imported

    from ortholoc_edge.adapters.camera import CameraOptions

logger = logging.getLogger(__name__)

_S = 1_000_000_000
_PORT_PROTOCOLS = frozenset({"tcp", "udp", "tls", "quic", "ws"})
_OTHER_PROTOCOLS = frozenset({"serial", "unixsock-stream", "unixpipe", "vsock"})
_MAX_PORT = 65535
# Nothing that we take is of more than 4 kB; a peer that sends more than this at once is cut off before it fills the
# memory (zenoh's own limit is a gigabyte).
_MOST_RECEIVED_BYTES = 1 << 20
# Where the camera's pictures come over it: a JPEG of twelve megapixels has six megabytes.
_MOST_PICTURE_BYTES = 16 << 20
_MOST_WAITING_COMMANDS = 16
_IMAGE_QUALITY = 70


class TlsOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[bus.tls]`` table, for ``tls/`` and ``quic/`` endpoints: PEM files, by path or, without a slash, by the
    name of a systemd credential.

    Attributes:
        certificate, private_key: ours, shown to whoever connects and to whom we connect to.
        root_ca: whom we believe; without one a ``connect`` endpoint's certificate must be of a public authority.
        mutual: whether who connects must show a certificate of ``root_ca``.
    """

    certificate: Annotated[str, Meta(min_length=1)] | None = None
    private_key: Annotated[str, Meta(min_length=1)] | None = None
    root_ca: Annotated[str, Meta(min_length=1)] | None = None
    mutual: bool = False

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.private_key is None):
            raise ValueError("certificate and private_key go together; write both or neither")
        if self.mutual and (self.root_ca is None or self.certificate is None):
            raise ValueError("mutual = true needs certificate, private_key and root_ca")


class BusOptions(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The ``[bus]`` table.

    Attributes:
        vehicle: the middle of the keys.
        listen: zenoh endpoints; loopback unless told otherwise. Multicast scouting stays off: it would tell
            every drone on the field's network of this one.
        connect: endpoints to connect to, of a router say; one that is not there is tried again and again.
        encoding: of what is published: "json", or "msgpack", which is half as long.
        commands: whether commands are accepted. Who reaches the bus may then steer what the autopilot is told: keep it
            on loopback, or use TLS with ``mutual``, or an access control list.
        image_rate_hz: of thumbnails; 0 publishes none. image_px: their long side.
        config: a zenoh configuration file (JSON5) to begin with, for access control lists above all; ``listen``,
            ``connect``, ``tls``, no multicast and the limit of a message are laid over it.
    """

    enabled: bool = False
    # No wildcards: zenoh would publish to every vehicle's key.
    vehicle: Annotated[str, Meta(pattern="^[A-Za-z0-9_.-]+$")] = "vehicle"
    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[str, ...] = ()
    encoding: Literal["json", "msgpack"] = "json"
    commands: bool = False
    image_rate_hz: Annotated[float, Meta(ge=0, le=10)] = 0.0
    image_px: Annotated[int, Meta(ge=64, le=1280)] = 320
    config: Annotated[str, Meta(min_length=1)] | None = None
    tls: TlsOptions = field(default_factory=TlsOptions)


class Bus:
    """A zenoh session that publishes and answers; never blocks the caller for a slow subscriber.

    Publishing is for one thread. Questions are answered by threads of the bus, from what was published last; what
    only the owner knows is asked of the owner.

    Attributes:
        dropped: messages that could not be published.
        refused: commands that were not carried out.
    Raises on construction: ConfigError if an endpoint is malformed; LinkError if no session can be had. A port that is
        in use, or an address that is not there yet, is waited for in the background.
    """

    def __init__(self, options: BusOptions, credentials: Path | None = None, *, takes_pictures: bool = False) -> None:
        """
        Args:
            credentials: systemd's folder of them.
            takes_pictures: whether `listen_to` will be used, so that longer messages must be let in.
        """
        import zenoh

        self.dropped = self.refused = 0
        self._key_of = zenoh.KeyExpr
        self._error = zenoh.ZError
        self._prefix = f"ortholoc/{options.vehicle}"
        self._options = options
        self._answers: Mapping[str, Callable[[], Struct]] = {}
        self._on_command: Callable[[Command], Answer] | None = None
        self._thread: threading.Thread | None = None
        self._latest: dict[str, tuple[bytes, str]] = {}
        self._last_image_ns: int | None = None
        config = _session_config(options, credentials, _MOST_PICTURE_BYTES if takes_pictures else _MOST_RECEIVED_BYTES)
        try:
            self._session = self._open(config)
        except zenoh.ZError as err:
            raise self._not_open(err) from err
        try:
            self._token = self._session.liveliness().declare_token(f"{self._prefix}/alive")
            self._publishers = {
                name: self._session.declare_publisher(
                    f"{self._prefix}/{name}", congestion_control=zenoh.CongestionControl.DROP
                )
                for name in (*PUBLISHED, "image")
            }
        except zenoh.ZError as err:
            self._session.close()  # type: ignore[no-untyped-call]
            raise self._not_open(err) from err

    def serve(self, answers: Mapping[str, Callable[[], Struct]], on_command: Callable[[Command], Answer]) -> None:
        """Begin to answer; once only.

        Args:
            answers: of the keys of `messages.ASKED`; called in a thread of the bus.
            on_command: carries out a command and returns what to answer; called in a thread of the bus, which may wait.
        Raises: LinkError.
        """
        import zenoh

        self._answers, self._on_command = answers, on_command
        try:
            self._questions = self._session.declare_queryable(f"{self._prefix}/*", self._answer)
            # Of too many at once the oldest go unanswered: a flood must not fill the memory.
            self._commands = self._session.declare_queryable(
                f"{self._prefix}/command/*", zenoh.handlers.RingChannel(_MOST_WAITING_COMMANDS)
            )
        except zenoh.ZError as err:
            raise self._not_open(err) from err
        self._thread = threading.Thread(target=self._serve_commands, name="bus-commands", daemon=True)
        self._thread.start()

    def _open(self, config: zenoh.Config) -> zenoh.Session:
        """Raises: zenoh.ZError."""
        import zenoh

        try:
            return zenoh.open(config)
        except zenoh.ZError as err:
            if not any(_can_not_be_had(endpoint) for endpoint in self._options.listen):
                raise
            # A port that another program holds, or an interface that is not up yet: no reason not to fly.
            logger.warning("%s; flying without who connects there, it is tried again and again", self._not_open(err))
        for key, value in {"listen/timeout_ms": -1, "listen/exit_on_failure": False}.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)

    def _not_open(self, err: zenoh.ZError) -> LinkError:
        return LinkError(
            f"zenoh can't listen on {', '.join(self._options.listen)} as {self._prefix!r} ({err}); free the port "
            "or choose another in [bus] of the configuration; else look at its certificates and [bus] config"
        )

    def listen_to(self, key: str, handler: Callable[[bytes, bytes], None]) -> Callable[[], None]:
        """Have ``handler`` called with payload and attachment of each message of a key, in a thread of the bus.

        Returns: what ends it.
        Raises: ConfigError for what is no key.
        """

        def hand_over(sample: zenoh.Sample) -> None:
            try:
                attachment = sample.attachment
                handler(sample.payload.to_bytes(), b"" if attachment is None else attachment.to_bytes())
            except Exception:  # one message; the next may do better
                logger.exception("zenoh: message of %s not taken", key)

        def end() -> None:
            # The session may be closed already.
            with contextlib.suppress(self._error):
                subscriber.undeclare()  # type: ignore[no-untyped-call]

        try:
            subscriber = self._session.declare_subscriber(key, hand_over)
        except self._error as err:
            raise ConfigError(f"{key!r} is no key of zenoh ({err}); write words with slashes between them") from err
        return end

    def retune(self, options: BusOptions) -> None:
        """Take over ``commands``, ``image_rate_hz`` and ``image_px``; the rest was used at the start."""
        self._options = options

    @property
    def accepts_commands(self) -> bool:
        return self._options.commands

    # -- what is published: the owner's thread -----------------------------------------------------------

    def publish(self, message: Published) -> None:
        """Send it to whoever listens. A failure is counted and logged, never raised: the flight goes on."""
        if self._options.encoding == "json":
            payload, encoding = msgspec.json.encode(message), JSON
        else:
            payload, encoding = msgspec.msgpack.encode(message), MSGPACK
        self._put(_TOPIC_OF[type(message)], payload, encoding)

    def publish_image(self, stamp_ns: int, image: ImageArray) -> None:
        """Send a thumbnail, if it is time for one. ``image``: grey or RGB; what is no picture is left out."""
        rate_hz = self._options.image_rate_hz
        if rate_hz == 0.0:
            return
        if self._last_image_ns is not None and 0 <= stamp_ns - self._last_image_ns < _S / rate_hz:
            return
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or not image.size:
            return
        self._last_image_ns = stamp_ns
        scale = min(1.0, self._options.image_px / max(image.shape[:2]))
        try:
            small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            drawn = small if small.ndim == 2 else cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
            data = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, _IMAGE_QUALITY])[1]
        except cv2.error:
            # One pixel high, say, or of five channels.
            self.dropped += 1
            return
        # The stamp tells which fix it belongs to.
        self._put("image", data.tobytes(), "image/jpeg", json.dumps({"stamp_ns": stamp_ns}).encode())

    def _put(self, name: str, payload: bytes, encoding: str, attachment: bytes | None = None) -> None:
        self._latest[name] = payload, encoding
        try:
            self._publishers[name].put(payload, encoding=encoding, attachment=attachment)
        except self._error:
            self.dropped += 1
            logger.warning("zenoh: %s not published", name, exc_info=True)

    # -- what is asked: threads of the bus ---------------------------------------------------------------

    def _answer(self, query: zenoh.Query) -> None:
        """The latest of each key that the question is about."""
        try:
            with query:
                for name in (*PUBLISHED, "image", *ASKED):
                    key = f"{self._prefix}/{name}"
                    if not query.key_expr.intersects(self._key_of(key)):
                        continue
                    found = self._found(name)
                    if found is not None:
                        query.reply(key, found[0], encoding=found[1])
        except self._error:
            # Who asked has gone.
            logger.debug("zenoh: question not answered", exc_info=True)
        except Exception:  # one question; the next may do better
            logger.exception("zenoh: question not answered")

    def _found(self, name: str) -> tuple[bytes, str] | None:
        if name in self._answers:
            message = self._answers[name]()
            if self._options.encoding == "json":
                return msgspec.json.encode(message), JSON
            return msgspec.msgpack.encode(message), MSGPACK
        return self._latest.get(name)

    def _serve_commands(self) -> None:
        while True:
            try:
                query = self._commands.recv()
            except self._error:
                return
            try:
                with query:
                    self._obey(query)
            except self._error:
                logger.debug("zenoh: command not answered", exc_info=True)
            except Exception:  # one command; the next may do better
                logger.exception("zenoh: command not answered")

    def _obey(self, query: zenoh.Query) -> None:
        name = str(query.key_expr).rpartition("/")[2]
        payload = b"" if query.payload is None else query.payload.to_bytes()
        encoding = "" if query.encoding is None else str(query.encoding)
        is_malformed = False
        try:
            if str(query.key_expr) != f"{self._prefix}/command/{name}" or "*" in name:
                raise CommandError(
                    name[:64], f"asked of {str(query.key_expr)[:128]!r}, which may be several vehicles",
                    f"ask {self._prefix}/command/NAME",
                )  # fmt: skip
            reply = self._carried_out(name, parse_command(name, payload, encoding, self._options.vehicle))
        except CommandError as error:
            reply, is_malformed = error.reply, True
        if not reply.accepted:
            self.refused += 1
            logger.warning("command %s refused: %s; %s", reply.command, reply.reason, reply.remedy)
        if encoding.partition(";")[0] == MSGPACK:
            answer, form = msgspec.msgpack.encode(reply), MSGPACK
        else:
            answer, form = msgspec.json.encode(reply), JSON
        if is_malformed:
            query.reply_err(answer, encoding=form)
        else:
            query.reply(str(query.key_expr), answer, encoding=form)

    def _carried_out(self, name: str, command: Command) -> CommandReply:
        if not self._options.commands or self._on_command is None:
            return CommandReply(
                command=name,
                accepted=False,
                reason="commands are not enabled on this vehicle",
                remedy="set [bus] commands = true in its configuration",
            )
        answer = self._on_command(command)
        return answer if isinstance(answer, CommandReply) else answer()

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]
        if self._thread is not None:
            self._thread.join(timeout=1.0)


def bus_of(options: BusOptions, camera: CameraOptions, environ: Mapping[str, str]) -> Bus:
    """As configured, with systemd's credentials. Raises: ConfigError, LinkError."""
    credentials = environ.get("CREDENTIALS_DIRECTORY")
    return Bus(options, Path(credentials) if credentials else None, takes_pictures=camera.kind == "zenoh")


_TOPIC_OF = {kind: name for name, kind in PUBLISHED.items()}


def _session_config(options: BusOptions, credentials: Path | None, most_received_bytes: int) -> zenoh.Config:
    """Raises: ConfigError naming the endpoint or file that can't be used."""
    import zenoh

    for endpoint in (*options.listen, *options.connect):
        if not _well_formed(endpoint):
            raise ConfigError(
                f"zenoh endpoint {endpoint!r} can't be used; write tcp/HOST:PORT, udp/HOST:PORT or tls/HOST:PORT in "
                "[bus] of the configuration"
            )
    settings: dict[str, Any] = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "listen/endpoints": list(options.listen),
        "transport/link/rx/max_message_size": most_received_bytes,
        # Between programs of one computer zenoh would copy through two pools of 16 MB, which fill within the hour.
        "transport/shared_memory/enabled": False,
        **_tls_settings(options.tls, credentials),
    }
    if options.connect:
        settings["connect/endpoints"] = list(options.connect)
        # Without an end, and the flight does not wait for it.
        settings["connect/timeout_ms"] = -1
        settings["connect/exit_on_failure"] = False
        # The camera's program may be what has to be found again: zenoh's own 4 s are 80 m of flight.
        settings["connect/retry"] = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
    try:
        config = zenoh.Config() if options.config is None else zenoh.Config.from_file(options.config)
    except zenoh.ZError as err:
        raise ConfigError(f"[bus] config: {options.config} can't be used ({err}); write zenoh's JSON5") from err
    try:
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as err:
        raise ConfigError(
            f"zenoh refuses to listen on {', '.join(options.listen)} ({err}); see [bus] in the configuration"
        ) from err
    return config


def _tls_settings(tls: TlsOptions, credentials: Path | None) -> dict[str, Any]:
    paths: dict[str, str] = {}
    for name in ("certificate", "private_key", "root_ca"):
        given = getattr(tls, name)
        if given is None:
            continue
        path = Path(given) if "/" in given else None if credentials is None else credentials / given
        if path is None:
            raise ConfigError(
                f"[bus.tls] {name}: {given!r} names a systemd credential, but there is no CREDENTIALS_DIRECTORY; write "
                f"LoadCredential={given}:/path into the unit, or a path with a slash here"
            )
        if not path.is_file():
            raise ConfigError(f"[bus.tls] {name}: {path} is no file; write the path of a PEM file")
        paths[name] = str(path)
    if not paths:
        return {}
    # zenoh asks for both sides' certificates by names of their own; ours are the same.
    keys = {
        "certificate": ("listen_certificate", "connect_certificate"),
        "private_key": ("listen_private_key", "connect_private_key"),
        "root_ca": ("root_ca_certificate",),
    }
    settings: dict[str, Any] = {f"transport/link/tls/{key}": path for name, path in paths.items() for key in keys[name]}
    settings["transport/link/tls/enable_mtls"] = tls.mutual
    return settings


def _can_not_be_had(endpoint: str) -> bool:
    """Whether its port is another's now, or its address nobody's on this computer. zenoh tells of that as of a wrong
    certificate, which no waiting mends."""
    protocol, _, address = endpoint.partition("/")
    host, _, rest = address.partition("#")[0].rpartition(":")
    if protocol not in _PORT_PROTOCOLS:
        return False
    kind = socket.SOCK_DGRAM if protocol in ("udp", "quic") else socket.SOCK_STREAM
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(rest.partition("?")[0]), type=kind)
        family, kind, number, _, at = found[0]
        with socket.socket(family, kind, number) as probe:
            # As zenoh does: what ended a moment ago is not in the way.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(at)
    except OSError:
        return True
    return False


def _well_formed(endpoint: str) -> bool:
    """Checked here since zenoh tells of a bad port or protocol only as it tells of a port in use."""
    protocol, _, address = endpoint.partition("/")
    if protocol in _OTHER_PROTOCOLS:
        return bool(address)
    match = re.fullmatch(r"[^?#]+:(\d{1,5})([?#].*)?", address)
    return protocol in _PORT_PROTOCOLS and match is not None and int(match[1]) <= _MAX_PORT
