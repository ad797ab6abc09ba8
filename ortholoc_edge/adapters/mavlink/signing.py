"""MAVLink 2 signing: whose frames count, and stamps that never repeat.

The codec's own check is not used. It notes a frame's stamp before it has looked at the signature, so that one forged
frame with a stamp of the far future shuts the true sender out; and it belongs to one parser, where a replay from
another address would meet a fresh one.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import logging
import os
from collections.abc import Mapping
from enum import StrEnum
from pathlib import Path

import msgspec

from ortholoc_edge.adapters.mavlink.codec import MavlinkMessage, dialect
from ortholoc_edge.adapters.mavlink.options import LinkOptions
from ortholoc_edge.adapters.secret import read_secret
from ortholoc_edge.errors import ConfigError

logger = logging.getLogger(__name__)

_KEY_BYTES = 32
_TRAILER_BYTES = 13
_SIGNATURE_BYTES = 6
# Stamps count 10 us from 2015-01-01, in 48 bits: until 2104.
_EPOCH_UNIX_NS = 1_420_070_400 * 1_000_000_000
_TICK_NS = 10_000
_TICKS_PER_S = 100_000
_MAX_STAMP = 2**48 - 1
# A stream not heard before is taken if it is not older than this (MAVLink's rule).
_ONE_MINUTE = 60 * _TICKS_PER_S
# A stamp that is stored is this far ahead, and stored again in a third of it: after a crash the next ones begin
# there, and none is used twice. Not more, since each crash puts our clock ahead of the others' by up to this.
_AHEAD = 30 * _TICKS_PER_S
STORE_INTERVAL_S = 10.0
# A wall clock before 2024 was not set: no board with this program is older.
_CLOCK_NOT_SET_BEFORE = 9 * 365 * 86400 * _TICKS_PER_S


class Verdict(StrEnum):
    """What a frame's signature says."""

    GOOD = "good"
    UNSIGNED = "unsigned"  # accepted where signatures are not required
    UNSIGNED_REFUSED = "unsigned_refused"
    BAD_SIGNATURE = "signature_bad"
    REPLAYED = "signature_replayed"  # not newer than what came before from there
    TOO_OLD = "signature_too_old"  # signed by the key, but more than a minute behind


ACCEPTED = (Verdict.GOOD, Verdict.UNSIGNED)


def stamp_of(unix_ns: int) -> int:
    """The stamp that belongs to a time of the wall clock; 0 before 2015."""
    return max(0, (unix_ns - _EPOCH_UNIX_NS) // _TICK_NS)


def signature_of(key: bytes, signed: bytes) -> bytes:
    """Of a frame up to and with its stamp."""
    return hashlib.sha256(key + signed).digest()[:_SIGNATURE_BYTES]


class Stamps:
    """Our own stamps: each above the one before, never behind the wall clock, in step with the monotonic one.

    An unset wall clock, or one that is put back, does not matter: time goes on from the first stamp.
    """

    def __init__(self, first: int, now_ns: int) -> None:
        self._first, self._start_ns = first, now_ns
        self.last = first

    def at(self, now_ns: int, unix_ns: int) -> int:
        """What a frame now may be no older than."""
        return max(self.last, self._first + (now_ns - self._start_ns) // _TICK_NS, stamp_of(unix_ns))

    def next(self, now_ns: int, unix_ns: int) -> int:
        """The stamp for one frame; another one for each."""
        self.last = min(max(self.last + 1, self.at(now_ns, unix_ns)), _MAX_STAMP)
        return self.last

    def heard(self, stamp: int) -> None:
        """A signed frame carried this one: ours must not fall behind, or its sender may refuse us."""
        self.last = max(self.last, stamp)


class Verifier:
    """Checks incoming signatures; one for the whole link, whatever address a frame comes from."""

    def __init__(self, key: bytes, *, require_signed: bool) -> None:
        self._key, self._require_signed = key, require_signed
        self._newest: dict[tuple[int, int, int], int] = {}

    def check(self, message: MavlinkMessage, own_stamp: int) -> tuple[Verdict, int]:
        """The verdict on a decoded message, and its stamp (0 without one).

        Args:
            own_stamp: our own time, against which a stream not heard before is judged.
        """
        frame = bytes(message.get_msgbuf())
        if frame[0] != dialect.PROTOCOL_MARKER_V2 or not frame[2] & dialect.MAVLINK_IFLAG_SIGNED:
            # The radio between us and the ground has no key.
            may_pass = not self._require_signed or message.get_msgId() == dialect.MAVLINK_MSG_ID_RADIO_STATUS
            return (Verdict.UNSIGNED if may_pass else Verdict.UNSIGNED_REFUSED), 0
        if not hmac.compare_digest(signature_of(self._key, frame[:-_SIGNATURE_BYTES]), frame[-_SIGNATURE_BYTES:]):
            return Verdict.BAD_SIGNATURE, 0
        link_id = frame[-_TRAILER_BYTES]
        stamp = int.from_bytes(frame[-_TRAILER_BYTES + 1 : -_SIGNATURE_BYTES], "little")
        stream = (link_id, message.get_srcSystem(), message.get_srcComponent())
        newest = self._newest.get(stream)
        if newest is None:
            if stamp + _ONE_MINUTE < own_stamp:
                return Verdict.TOO_OLD, stamp
        elif stamp <= newest:
            return Verdict.REPLAYED, stamp
        self._newest[stream] = stamp
        return Verdict.GOOD, stamp


class StampStore:
    """The stamp from which the next life of the program must begin, in a file; written whole or not at all."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def load(self) -> int | None:
        """None where nothing was stored yet, or what is there is damaged (which is logged)."""
        try:
            stamp = int(self._path.read_text(encoding="ascii"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            logger.error(
                "signing stamps in %s can't be read (%s); going by the wall clock, and stamps of before may be used "
                "again if it is behind", self._path, error,
            )  # fmt: skip
            return None
        return stamp if 0 <= stamp <= _MAX_STAMP else None

    def save(self, stamp: int) -> None:
        """Raises: OSError."""
        beside = self._path.with_name(self._path.name + ".new")
        with beside.open("w", encoding="ascii") as file:
            file.write(f"{stamp}\n")
            file.flush()
            os.fsync(file.fileno())
        beside.replace(self._path)
        folder = os.open(self._path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


class Signing:
    """Key, stamps and checks of one link.

    :meth:`sign_next` and :meth:`check` are for the link's thread. :meth:`store` writes to a disk that may take its
    time, so it is for another one.
    """

    def __init__(self, key: bytes, link_id: int, store: StampStore, *, require_signed: bool) -> None:
        self._key, self._link_id, self._store = key, link_id, store
        self._verifier = Verifier(key, require_signed=require_signed)
        self._stamps: Stamps | None = None

    def start(self, now_ns: int, unix_ns: int) -> None:
        """Begin where the life before can't have been, and see that what we use can be stored.

        Raises: ConfigError if it can't, and never could.
        """
        stored, wall = self._store.load(), stamp_of(unix_ns)
        if wall < _CLOCK_NOT_SET_BEFORE and stored is None:
            logger.warning(
                "signing: the wall clock is not set and no stamp is stored from before; a peer that heard us before "
                "will refuse our frames. Set the clock"
            )
        self._stamps = Stamps(max(wall, stored or 0), now_ns)
        try:
            self.store()
        except OSError as error:
            if stored is not None:
                # A disk that filled up since is no error of configuration, and this may be a restart in the air.
                logger.error(
                    "signing's stamps can't be stored (%s); going on from the stored one. Until they can be, a restart "
                    "would use stamps again if the wall clock is behind", error,
                )  # fmt: skip
                return
            raise ConfigError(
                f"[link] signing_state: stamps can't be stored ({error}); without that they would repeat after a "
                "restart. Name a file in a folder that may be written"
            ) from error

    def prepare(self, mav: MavlinkMessage) -> None:
        """Make an encoder sign what it packs."""
        mav.signing.secret_key = self._key
        mav.signing.link_id = self._link_id
        mav.signing.sign_outgoing = True

    def sign_next(self, mav: MavlinkMessage, now_ns: int, unix_ns: int) -> None:
        """Give the encoder the stamp of the frame that it packs next."""
        mav.signing.timestamp = self._started.next(now_ns, unix_ns)

    def check(self, message: MavlinkMessage, now_ns: int, unix_ns: int) -> Verdict:
        """Whether a message counts: `ACCEPTED`, or not."""
        stamps = self._started
        verdict, stamp = self._verifier.check(message, stamps.at(now_ns, unix_ns))
        if verdict is Verdict.GOOD:
            stamps.heard(stamp)
        return verdict

    def store(self) -> None:
        """Store a stamp ahead of those in use. Raises: OSError."""
        self._store.save(min(self._started.last + _AHEAD, _MAX_STAMP))

    def finish(self) -> None:
        """Store where the next life may begin, now that no more frames are signed."""
        with contextlib.suppress(OSError):  # what was stored before is ahead of it
            self._store.save(min(self._started.last + 1, _MAX_STAMP))

    @property
    def _started(self) -> Stamps:
        if self._stamps is None:
            raise RuntimeError("signing was not started")
        return self._stamps


def read_key(name: str, environ: Mapping[str, str]) -> bytes:
    """The key from a file of 32 bytes or of 64 hexadecimal digits.

    Args:
        name: a path, or without a slash the name of a systemd credential (LoadCredential=).
        environ: for ``CREDENTIALS_DIRECTORY``.
    Raises: ConfigError that says what is wrong with it, and never what is in it.
    """
    path, content = read_secret(name, environ, "[link] signing_key")
    key = content
    if len(content) != _KEY_BYTES:
        try:
            key = bytes.fromhex(content.decode("ascii").strip())
        except ValueError:
            key = b""
    if len(key) != _KEY_BYTES:
        raise ConfigError(
            f"[link] signing_key: {path} has {len(content)} bytes; a key is 32 bytes, or 64 hexadecimal digits"
        )
    if not any(key):
        raise ConfigError(f"[link] signing_key: {path} is all zeros; that is how signing is switched off")
    return key


def _state_path(options: LinkOptions, environ: Mapping[str, str]) -> Path:
    if options.signing_state is not None:
        return Path(options.signing_state)
    if environ.get("STATE_DIRECTORY"):
        # systemd separates several by colons.
        return Path(environ["STATE_DIRECTORY"].split(":")[0]) / "mavlink-signing"
    raise ConfigError(
        "[link] signing_state: name a file for signing's stamps, which must never repeat; only under systemd with "
        "StateDirectory= is there a place for it by itself"
    )


def beside(options: LinkOptions, name: str, environ: Mapping[str, str]) -> LinkOptions:
    """The options for another program on the same link and with the same key: stamps and a link id of its own.

    Two that kept one file of stamps would each overwrite what the other needs after a restart.
    Raises: ConfigError where stamps have no place.
    """
    if options.signing_key is None:
        return options
    path = _state_path(options, environ)
    return msgspec.structs.replace(
        options,
        signing_link_id=(options.signing_link_id + 128) % 256,
        signing_state=str(path.with_name(f"{path.name}.{name}")),
    )


def make_signing(options: LinkOptions, environ: Mapping[str, str]) -> Signing | None:
    """As configured; None without a key.

    Raises: ConfigError for a key that can't be used, or stamps that have no place.
    """
    if options.signing_key is None:
        if options.require_signed:
            raise ConfigError("[link] require_signed needs signing_key: without a key no signature can be checked")
        return None
    key, path = read_key(options.signing_key, environ), _state_path(options, environ)
    return Signing(key, options.signing_link_id, StampStore(path), require_signed=options.require_signed)
