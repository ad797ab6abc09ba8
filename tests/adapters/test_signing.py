"""MAVLink 2 signing: keys, stamps across lives of the program, what is refused, and pymavlink as a peer."""

from __future__ import annotations

import contextlib
import errno
import socket
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.mavlink import AutopilotLink, LinkOptions
from ortholoc_edge.adapters.mavlink import link as link_module
from ortholoc_edge.adapters.mavlink.codec import FrameParser
from ortholoc_edge.adapters.mavlink.estimates import VisionEstimate
from ortholoc_edge.adapters.mavlink.signing import (
    ACCEPTED,
    Signing,
    Stamps,
    StampStore,
    Verdict,
    Verifier,
    beside,
    make_signing,
    read_key,
    stamp_of,
)
from ortholoc_edge.clock import SystemClock
from ortholoc_edge.errors import ConfigError

KEY, OTHER = bytes(range(32)), b"another key of thirty-two bytes!"
S = 1_000_000_000
TICKS_PER_S = 100_000
NOW = stamp_of(1_796_000_000 * S)  # in 2026
# -- keys ------------------------------------------------------------------------


def key_file(folder: Path, content: bytes = KEY, mode: int = 0o600) -> str:
    path = folder / "mavlink.key"
    path.write_bytes(content)
    path.chmod(mode)
    return str(path)


@pytest.mark.parametrize("content", [KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"])
def test_key_is_read_raw_or_in_digits(content, tmp_path):
    assert read_key(key_file(tmp_path, content), {}) == KEY
    assert read_key("mavlink.key", {"CREDENTIALS_DIRECTORY": str(tmp_path)}) == KEY


@pytest.mark.parametrize(
    ("content", "mode", "named"),
    [
        (KEY, 0o644, "others than its owner may read or write .*mode 644.*chmod 600"),
        (KEY, 0o640, "others than its owner may read or write .*mode 640.*chmod 600"),
        (KEY, 0o620, "others than its owner"),
        (KEY[:31], 0o600, "has 31 bytes; a key is 32 bytes, or 64 hexadecimal digits"),
        (KEY.hex().encode()[:-1] + b"g", 0o600, "has 64 bytes"),
        (b"", 0o600, "has 0 bytes"),
        (bytes(32), 0o600, "all zeros"),
    ],
)
def test_unusable_key_is_refused_and_not_shown(content, mode, named, tmp_path):
    with pytest.raises(ConfigError, match=named) as refused:
        read_key(key_file(tmp_path, content, mode), {})
    assert KEY.hex()[:20] not in str(refused.value)


def test_a_credentials_access_list_is_not_its_group(tmp_path):
    key_file(tmp_path, mode=0o440)
    assert read_key("mavlink.key", {"CREDENTIALS_DIRECTORY": str(tmp_path)}) == KEY
    key_file(tmp_path, mode=0o644)
    with pytest.raises(ConfigError, match="mode 644"):
        read_key("mavlink.key", {"CREDENTIALS_DIRECTORY": str(tmp_path)})


def test_a_key_that_is_not_there_gets_a_remedy(tmp_path):
    with pytest.raises(ConfigError, match=r"can't be read.*owns.*mode 600.*credential"):
        read_key(str(tmp_path / "none"), {})


def test_missing_key_or_place_is_named(tmp_path):
    with pytest.raises(ConfigError, match="can't be read: No such file"):
        read_key(str(tmp_path / "none"), {})
    with pytest.raises(ConfigError, match="LoadCredential=vehicle:"):
        read_key("vehicle", {})
    options = LinkOptions(endpoint="udp:h:1", signing_key=key_file(tmp_path))
    with pytest.raises(ConfigError, match="signing_state"):
        make_signing(options, {})
    assert make_signing(options, {"STATE_DIRECTORY": f"{tmp_path}:/other"}) is not None
    with pytest.raises(ConfigError, match="require_signed needs signing_key"):
        AutopilotLink(LinkOptions(endpoint="udp:h:1", require_signed=True), SystemClock())
    assert make_signing(LinkOptions(endpoint="udp:h:1"), {}) is None


def test_state_that_cannot_be_written_is_refused_at_the_start(tmp_path):
    options = LinkOptions(
        endpoint="udp:127.0.0.1:14999", signing_key=key_file(tmp_path), signing_state=str(tmp_path / "no" / "state")
    )
    link = AutopilotLink(options, SystemClock())
    with pytest.raises(ConfigError, match="signing_state: stamps can't be stored"):
        link.start()
    link.stop()


def test_a_disk_that_filled_up_since_does_not_end_a_restart_in_the_air(tmp_path, caplog):
    class Full(StampStore):
        def save(self, stamp: int) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "stamps"
    path.write_text("37000000000000\n")
    signing = Signing(b"k" * 32, 0, Full(path), require_signed=False)
    signing.start(S, 0)
    assert "No space left" in caplog.text and caplog.records[-1].levelname == "ERROR"
    assert signing._started.next(S, 0) > 37000000000000
    path.unlink()
    with pytest.raises(ConfigError, match="No space left"):
        Signing(b"k" * 32, 0, Full(path), require_signed=False).start(S, 0)


# -- stamps ----------------------------------------------------------------------


def test_stamp_is_ten_microseconds_since_2015():
    assert stamp_of(1_420_070_400 * S) == 0 and stamp_of(0) == 0
    assert stamp_of(1_420_070_401 * S) == TICKS_PER_S


@given(steps=st.lists(st.tuples(st.integers(0, 10**10), st.integers(-(10**18), 10**18)), min_size=1, max_size=30))
def test_stamps_only_rise_whatever_the_wall_clock_does(steps):
    stamps = Stamps(NOW, 0)
    now, last = 0, NOW
    for step, wall_offset in steps:
        now += step
        unix = max(0, 1_796_000_000 * S + wall_offset)
        stamp = stamps.next(now, unix)
        assert stamp > last and stamp >= stamp_of(unix)
        # In step with time, even where the wall clock was never set.
        assert stamp >= NOW + now // 10_000
        last = stamp


@settings(deadline=None, max_examples=25)  # it writes to a disk
@given(lives=st.lists(st.tuples(st.integers(0, 25), st.booleans(), st.integers(-4000, 60)), min_size=1, max_size=6))
def test_no_stamp_is_used_twice_across_crashes(lives, tmp_path_factory):
    """Each life signs 5 frames a second for some seconds, stores every 10 s, then stops or is killed; the wall clock
    is anywhere."""
    store = StampStore(tmp_path_factory.mktemp("state") / "stamps")
    newest = -1
    for seconds, is_killed, wall_s in lives:
        signing, mav = Signing(KEY, 0, store, require_signed=False), dialect.MAVLink(None, 1, 197)
        unix = (1_796_000_000 + wall_s) * S
        signing.start(0, unix)
        for tick in range(5 * seconds):
            signing.sign_next(mav, tick * S // 5, unix + tick * S // 5)
            assert mav.signing.timestamp > newest
            newest = mav.signing.timestamp
            if tick % 50 == 49:
                signing.store()
        if not is_killed:
            signing.finish()


def test_a_clock_that_was_never_set_follows_the_peers(tmp_path):
    """Or the peer, who knows the time, would refuse us."""
    signing, mav = Signing(KEY, 0, StampStore(tmp_path / "stamps"), require_signed=True), dialect.MAVLink(None, 1, 197)
    signing.start(0, 0)
    signing.sign_next(mav, 0, 0)
    assert mav.signing.timestamp < NOW
    assert signing.check(signed(BEAT, NOW), S, 0) is Verdict.GOOD
    signing.sign_next(mav, S, 0)
    assert mav.signing.timestamp > NOW


def test_damaged_state_is_said_and_the_clock_goes_on(tmp_path, caplog):
    path = tmp_path / "stamps"
    path.write_bytes(b"\xff garbage")
    signing, mav = Signing(KEY, 0, StampStore(path), require_signed=False), dialect.MAVLink(None, 1, 197)
    signing.start(0, 1_796_000_000 * S)
    signing.sign_next(mav, 0, 1_796_000_000 * S)
    assert mav.signing.timestamp == NOW + 1 and "can't be read" in caplog.text
    assert StampStore(path).load() > NOW


def test_clock_of_1970_is_said(tmp_path, caplog):
    Signing(KEY, 0, StampStore(tmp_path / "stamps"), require_signed=False).start(0, 5 * S)
    assert "clock is not set" in caplog.text


# -- what is refused -------------------------------------------------------------


def signed(message, stamp: int, key: bytes = KEY, system: int = 7, component: int = 1, link_id: int = 3):
    """As pymavlink signs it, decoded by a parser without a key."""
    mav = dialect.MAVLink(None, system, component)
    mav.signing.secret_key, mav.signing.sign_outgoing = key, True
    mav.signing.timestamp, mav.signing.link_id = stamp, link_id
    (decoded,) = FrameParser().feed(bytes(message.pack(mav)), 0)
    return decoded


def plain(message, version_1: bool = False):
    frame = message.pack(dialect.MAVLink(None, 7, 1), force_mavlink1=version_1)
    (decoded,) = FrameParser().feed(bytes(frame), 0)
    return decoded


BEAT = dialect.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
RADIO = dialect.MAVLink_radio_status_message(1, 1, 1, 1, 1, 1, 1)


def verdicts(verifier: Verifier, *messages) -> list[Verdict]:
    return [verifier.check(message, NOW)[0] for message in messages]


def test_signature_and_stamp_are_checked_per_stream():
    verifier = Verifier(KEY, require_signed=True)
    first, second = signed(BEAT, NOW), signed(BEAT, NOW + 1)
    assert verdicts(verifier, first, second) == ["good"] * 2
    assert verdicts(verifier, second, first) == ["signature_replayed"] * 2
    # Another link, system or component has a count of its own.
    others = [signed(BEAT, NOW, link_id=4), signed(BEAT, NOW, system=8), signed(BEAT, NOW, component=154)]
    assert verdicts(verifier, *others) == ["good"] * 3
    assert verdicts(verifier, signed(BEAT, NOW + 2, key=OTHER)) == ["signature_bad"]
    # One bit of the payload.
    touched = signed(BEAT, NOW + 3)
    touched._msgbuf = bytearray(touched.get_msgbuf())
    touched._msgbuf[12] ^= 1
    assert verdicts(verifier, touched) == ["signature_bad"]


def test_a_forged_stamp_does_not_shut_the_sender_out():
    verifier = Verifier(KEY, require_signed=True)
    assert verdicts(verifier, signed(BEAT, NOW)) == ["good"]
    assert verdicts(verifier, signed(BEAT, 2**48 - 1, key=OTHER)) == ["signature_bad"]
    assert verdicts(verifier, signed(BEAT, NOW + 1)) == ["good"]


def test_a_new_stream_may_be_one_minute_old():
    minute = 60 * TICKS_PER_S
    assert verdicts(Verifier(KEY, require_signed=True), signed(BEAT, NOW - minute)) == ["good"]
    verifier = Verifier(KEY, require_signed=True)
    assert verdicts(verifier, signed(BEAT, NOW - minute - 1)) == ["signature_too_old"]
    # Refused ones leave no trace; once its clock has caught up it is taken.
    assert verdicts(verifier, signed(BEAT, NOW - 5)) == ["good"]


def test_unsigned_frames():
    strict, lenient = Verifier(KEY, require_signed=True), Verifier(KEY, require_signed=False)
    assert verdicts(strict, plain(BEAT), plain(BEAT, True)) == ["unsigned_refused"] * 2
    assert verdicts(strict, plain(RADIO), plain(RADIO, True)) == ["unsigned"] * 2
    assert verdicts(lenient, plain(BEAT)) == ["unsigned"]
    assert verdicts(lenient, signed(BEAT, NOW, key=OTHER)) == ["signature_bad"]
    assert Verdict.UNSIGNED in ACCEPTED and Verdict.UNSIGNED_REFUSED not in ACCEPTED


def test_a_refused_frame_is_passed_over_with_all_that_it_holds():
    """A text that holds a whole frame, signed well: the outer frame is refused, and the inner one was never sent."""
    inner = bytes(signed(BEAT, NOW).get_msgbuf())
    outer = bytes(dialect.MAVLink_statustext_message(4, inner + b"x" * 6).pack(dialect.MAVLink(None, 7, 1)))
    verifier = Verifier(KEY, require_signed=True)
    parser = FrameParser(lambda message: verifier.check(message, NOW)[0] in ACCEPTED)
    assert parser.feed(outer, 0) == []
    assert len(parser.feed(inner, 0)) == 1


# -- pymavlink as a peer ---------------------------------------------------------


class Peer:
    """An autopilot of pymavlink's own connection class, which signs and checks by itself."""

    def __init__(self, key: bytes | None = KEY) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.connection = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{self.port}", source_system=7, source_component=1, dialect="ardupilotmega"
        )
        if key is not None:
            self.connection.setup_signing(key, sign_outgoing=True, allow_unsigned_callback=None, link_id=9)
        self.got: list = []

    def turn(self) -> None:
        """Hear what came, and beat."""
        while (message := self.connection.recv_match(blocking=False)) is not None:
            self.got.append(message)
        # To nobody, until somebody spoke.
        self.connection.mav.heartbeat_send(2, 3, 128, 0, 4, 3)

    def until(self, condition, seconds: float = 8.0) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, "did not happen in time"
            self.turn()
            time.sleep(0.02)

    def heard(self, name: str) -> list:
        return [m for m in self.got if m.get_type() == name]


@contextlib.contextmanager
def link_to(peer: Peer, folder: Path, **options):
    chosen = LinkOptions(
        endpoint=f"udpout:127.0.0.1:{peer.port}",
        signing_key=key_file(folder),
        signing_state=str(folder / "stamps"),
        **options,
    )
    with AutopilotLink(chosen, SystemClock()) as link:
        yield link
    assert link.failure is None


@pytest.fixture
def peer(request):
    one = Peer(getattr(request, "param", KEY))
    yield one
    one.connection.close()


def test_pymavlink_and_we_accept_each_other_across_restarts(peer, tmp_path, monkeypatch):
    monkeypatch.setattr(link_module, "STORE_INTERVAL_S", 0.05)
    estimate = VisionEstimate(time.monotonic_ns(), np.zeros(3), np.eye(3), np.eye(6))
    newest = 0
    for life in range(1, 3):
        with link_to(peer, tmp_path, require_signed=True, signing_link_id=5) as link:
            peer.until(link.connected)
            link.send_estimate(estimate)
            peer.until(lambda life=life: len(peer.heard("ODOMETRY")) == life)
            # Also while it lives, for a life that ends in a crash.
            stored = StampStore(tmp_path / "stamps").load()
            peer.until(lambda stored=stored: StampStore(tmp_path / "stamps").load() > stored)
            statistics = link.statistics()
        assert not [name for name in statistics if name.startswith(("signature_", "unsigned_"))]
        odometry = peer.heard("ODOMETRY")[-1]
        assert odometry.get_signed() and odometry.get_link_id() == 5
        stamp = int.from_bytes(odometry.get_msgbuf()[-12:-6], "little")
        assert stamp > newest
        newest = stamp
        assert StampStore(tmp_path / "stamps").load() > newest
    assert peer.connection.mav.signing.badsig_count == peer.connection.mav.signing.reject_count == 0
    assert not peer.heard("SETUP_SIGNING")


@pytest.mark.parametrize("peer", [OTHER, None], indirect=True, ids=["other-key", "no-key"])
def test_who_has_not_the_key_is_not_our_autopilot(peer, tmp_path, caplog):
    wanted = "signature_bad" if peer.connection.mav.signing.sign_outgoing else "unsigned_refused"
    with link_to(peer, tmp_path, require_signed=True) as link:
        peer.until(lambda: link.statistics().get(wanted, 0) >= 3)
        assert link.vehicle is None and not link.connected()
    assert len([r for r in caplog.records if "refused" in r.getMessage()]) == 1, "said once, not for each"


def test_unsigned_peer_is_heard_where_that_is_allowed(tmp_path):
    peer = Peer(None)
    try:
        with link_to(peer, tmp_path) as link:
            peer.until(link.connected)
            peer.until(lambda: peer.heard("HEARTBEAT"))
    finally:
        peer.connection.close()


def test_setup_signing_with_our_key_changes_nothing(peer, tmp_path):
    """It would carry the next key in the clear; we neither take it nor say it."""
    with link_to(peer, tmp_path, require_signed=True) as link:
        peer.until(link.connected)
        peer.connection.mav.setup_signing_send(7, 197, list(OTHER), NOW)
        peer.until(lambda: "received.SETUP_SIGNING" in link.statistics())
        count = len(peer.heard("HEARTBEAT"))
        peer.until(lambda: len(peer.heard("HEARTBEAT")) > count)
        assert "SETUP_SIGNING" not in [name.split(".")[-1] for name in link.statistics() if name.startswith("sent")]
    assert peer.connection.mav.signing.reject_count == 0


def test_a_peer_whose_clock_is_behind_is_spoken_to(tmp_path):
    """Where we listen we learn addresses from frames. One that is refused for its age alone has the key; a signed
    heartbeat of ours lets its clock catch up."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    connection = mavutil.mavlink_connection(
        f"udpout:127.0.0.1:{port}", source_system=7, source_component=1, dialect="ardupilotmega"
    )
    connection.setup_signing(KEY, sign_outgoing=True, initial_timestamp=NOW - 86400 * 365 * TICKS_PER_S)
    options = LinkOptions(
        endpoint=f"udp:127.0.0.1:{port}", signing_key=key_file(tmp_path), signing_state=str(tmp_path / "stamps"),
        require_signed=True,
    )  # fmt: skip
    try:
        with AutopilotLink(options, SystemClock()) as link:
            deadline = time.monotonic() + 8.0
            while not link.connected():
                assert time.monotonic() < deadline
                connection.mav.heartbeat_send(2, 3, 128, 0, 4, 3)
                connection.recv_match(blocking=False)
                time.sleep(0.05)
            assert link.statistics()["signature_too_old"] >= 1
    finally:
        connection.close()


def test_another_program_beside_has_stamps_of_its_own(tmp_path):
    """`doctor` while the daemon flies: neither file nor link id is shared."""
    options = LinkOptions(endpoint="udp:x:1", signing_key="/key", signing_link_id=3)
    environ = {"STATE_DIRECTORY": str(tmp_path)}
    other = beside(options, "doctor", environ)
    assert other.signing_link_id != options.signing_link_id
    assert other.signing_state == str(tmp_path / "mavlink-signing.doctor")
    named = beside(msgspec.structs.replace(options, signing_state="/var/x/stamps", signing_link_id=200), "doctor", {})
    assert (named.signing_state, named.signing_link_id) == ("/var/x/stamps.doctor", 72)
    unsigned = LinkOptions(endpoint="udp:x:1")
    assert beside(unsigned, "doctor", {}) is unsigned
