"""Reading and setting parameters, on a scripted clock against a scripted autopilot."""

from __future__ import annotations

import math
import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from ortholoc_edge.adapters.mavlink.codec import payload_of
from ortholoc_edge.adapters.mavlink.estimates import Autopilot
from ortholoc_edge.adapters.mavlink.parameters import Answer, ParameterClient, Reading, decode_value, encode_value

MS = 1_000_000
S = 1_000_000_000
INT8, INT16, INT32, REAL = 2, 4, 6, 9
ARDUPILOT, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4


def received(message):
    (decoded,) = dialect.MAVLink(None, 0, 0).parse_buffer(message.pack(dialect.MAVLink(None, 7, 1)))
    return decoded


def value(name: str, number: float, kind: int):
    return received(dialect.MAVLink_param_value_message(name.encode(), number, kind, 9, 1))


def bytewise(name: str, number: int):
    return value(name, struct.unpack("<f", struct.pack("<i", number))[0], INT32)


def error(name: str, code: int):
    return received(dialect.MAVLink_param_error_message(1, 197, name.encode(), -1, code))


class Script:
    """Polls every 50 ms and answers by a function from a message sent to messages that arrive 10 ms later."""

    def __init__(self, client: ParameterClient, autopilot: Autopilot, answer) -> None:
        self.client, self.autopilot, self.answer = client, autopilot, answer
        self.now_ns = 1000 * S
        self.sent = []

    def run(self, seconds: float) -> None:
        end_ns = self.now_ns + int(seconds * S)
        while self.now_ns < end_ns:
            out = [received(m) for m in self.client.poll(self.now_ns, 7, self.autopilot)]
            self.sent += [(self.now_ns, m) for m in out]
            for message in out:
                assert (message.target_system, message.target_component) == (7, 1)
                for reply in self.answer(message):
                    if reply.get_type() == "PARAM_ERROR":
                        self.client.on_error(reply)
                    else:
                        self.client.on_value(reply, self.autopilot, self.now_ns + 10 * MS)
            self.now_ns += 50 * MS

    def asked(self, name: str) -> int:
        return sum(m.get_type() == "PARAM_REQUEST_READ" and m.param_id == name for _, m in self.sent)


# -- encodings -----------------------------------------------------------------


@given(number=st.integers(-(2**31), 2**31 - 1).filter(lambda n: not 0x7F800000 < n & 0x7FFFFFFF < 0x7FC00000))
def test_px4s_integers_are_the_bytes_of_the_float(number):
    """Signalling NaNs excepted: not every machine moves those unchanged."""
    assert decode_value(bytewise("MAV_0_CONFIG", number), PX4) == number
    sent = received(
        dialect.MAVLink_param_set_message(7, 1, b"X", encode_value(number, INT32, PX4), INT32)
    )
    assert struct.unpack("<i", payload_of(sent, 4)[:4])[0] == number


def test_ardupilots_integers_are_cast():
    assert decode_value(value("EK3_SRC2_POSXY", 6.0, INT8), ARDUPILOT) == 6
    assert isinstance(decode_value(value("EK3_SRC2_POSXY", 6.0, INT8), ARDUPILOT), int)
    assert encode_value(6, INT8, ARDUPILOT) == 6.0
    # What one stack means is nonsense by the rule of the other.
    assert decode_value(value("EKF2_EV_CTRL", 1.0, INT32), PX4) == 0x3F800000


def test_reals_are_reals_for_both():
    for autopilot in Autopilot:
        assert decode_value(value("X", 0.25, REAL), autopilot) == 0.25
        assert encode_value(0.25, REAL, autopilot) == 0.25


@pytest.mark.parametrize(
    ("number", "kind", "autopilot"),
    [
        (math.nan, REAL, ARDUPILOT), (math.inf, REAL, PX4), (math.nan, INT8, ARDUPILOT), (6.5, INT8, ARDUPILOT),
        (300.0, INT8, ARDUPILOT), (-1e30, INT32, ARDUPILOT), (1.0, 0, ARDUPILOT), (1.0, 10, PX4), (1.0, 77, PX4),
        (1.0, INT16, PX4),
    ],
)  # fmt: skip
def test_values_that_cannot_be_meant_are_none(number, kind, autopilot):
    assert decode_value(value("X", number, kind), autopilot) is None


@given(payload=st.binary(min_size=25, max_size=25), autopilot=st.sampled_from(list(Autopilot)))
def test_any_payload_is_borne(payload, autopilot):
    client = ParameterClient()
    client.read(["VISO_TYPE"])
    number, count, index, name, kind = struct.unpack("<fHH16sB", payload)
    message = received(dialect.MAVLink_param_value_message(name, number, kind, count, index))
    client.on_value(message, autopilot, 0)
    # Its own name is not among random bytes.
    assert client.readings == {"VISO_TYPE": Reading(Answer.OPEN)}


# -- reading -------------------------------------------------------------------


def test_present_absent_and_slow_ones():
    have, lost = {"AHRS_EKF_TYPE": 3.0, "VISO_TYPE": 1.0}, {"VISO_TYPE": 2}

    def answer(message):
        name = message.param_id
        if lost.get(name, 0) > 0:
            lost[name] -= 1
            return []
        return [value(name, have[name], INT8)] if name in have else []

    client = ParameterClient()
    client.read([*have, "GPS1_TYPE"])
    script = Script(client, ARDUPILOT, answer)
    script.run(6.0)
    assert client.readings == {
        "AHRS_EKF_TYPE": Reading(Answer.VALUE, 3, INT8),
        "VISO_TYPE": Reading(Answer.VALUE, 1, INT8),
        "GPS1_TYPE": Reading(Answer.ABSENT),
    }
    assert not client.busy
    assert (script.asked("AHRS_EKF_TYPE"), script.asked("VISO_TYPE"), script.asked("GPS1_TYPE")) == (1, 3, 5)


def test_silence_of_all_is_not_absence():
    client = ParameterClient()
    client.read(["VISO_TYPE", "AHRS_EKF_TYPE"])
    Script(client, ARDUPILOT, lambda m: []).run(6.0)
    assert {r.answer for r in client.readings.values()} == {Answer.SILENT}


def test_a_lossy_line_does_not_make_parameters_absent():
    """Of a hundred exchanges nineteen are lost: one parameter in four thousand would seem absent (0.19 ** 5)."""
    line = random.Random(3)
    names = [f"P{i}" for i in range(60)]
    client = ParameterClient()
    client.read(names)
    Script(client, ARDUPILOT, lambda m: [value(m.param_id, 1.0, INT8)] if line.random() > 0.19 else []).run(15.0)
    assert {r.answer for r in client.readings.values()} == {Answer.VALUE}


def test_an_error_message_ends_the_question_at_once():
    client = ParameterClient()
    client.read(["GPS1_TYPE", "VISO_TYPE"])
    codes = {"GPS1_TYPE": 1, "VISO_TYPE": 3}
    script = Script(client, ARDUPILOT, lambda m: [error(m.param_id, codes[m.param_id])])
    script.run(0.3)
    assert client.readings["GPS1_TYPE"].answer is Answer.ABSENT
    # Permission denied says nothing of whether it is there.
    assert client.readings["VISO_TYPE"].answer is Answer.OPEN


def test_garbage_is_asked_again_and_never_believed():
    answers = iter([math.nan, 1e9, 1.0])
    client = ParameterClient()
    client.read(["VISO_TYPE", "VISO_SCALE"])

    def answer(message):
        if message.param_id == "VISO_SCALE":
            return [value("VISO_SCALE", math.inf, REAL)]
        return [value("VISO_TYPE", next(answers), INT8)]

    Script(client, ARDUPILOT, answer).run(6.0)
    assert client.readings["VISO_TYPE"] == Reading(Answer.VALUE, 1, INT8)
    assert client.readings["VISO_SCALE"] == Reading(Answer.UNREADABLE)
    assert client.counts["parameters_unreadable"] == 2 + 5


def test_others_parameters_are_passed_over_and_later_changes_taken():
    client = ParameterClient()
    client.read(["VISO_TYPE"])
    client.on_value(value("THR_MAX", 1.0, INT8), ARDUPILOT, 0)
    client.on_value(value("VISO_TYPE", 0.0, INT8), ARDUPILOT, 0)
    client.on_value(value("VISO_TYPE", 1.0, INT8), ARDUPILOT, 1)  # set at the ground station
    assert client.readings == {"VISO_TYPE": Reading(Answer.VALUE, 1, INT8)}


def test_requests_are_spread():
    """34 a second at most, so that a slow line still carries attitude."""
    client = ParameterClient()
    client.read([f"P{i}" for i in range(200)])
    script = Script(client, ARDUPILOT, lambda m: [])
    script.run(3.0)
    assert 90 <= len(script.sent) <= 3.0 * 34 + 4


def test_a_restart_asks_for_everything_again():
    client = ParameterClient()
    client.read(["VISO_TYPE"])
    script = Script(client, ARDUPILOT, lambda m: [value("VISO_TYPE", 1.0, INT8)])
    script.run(1.0)
    client.write("VISO_TYPE", 0)
    client.restart()
    (written,) = client.take_written()
    assert not written.accepted and "restarted" in written.why
    script.run(1.0)
    assert script.asked("VISO_TYPE") == 2 and client.readings["VISO_TYPE"].value == 1


@pytest.mark.parametrize("name", ["", "A" * 17, "VISO_TYPÉ"])
def test_impossible_names(name):
    with pytest.raises(ValueError, match="16 ASCII"):
        ParameterClient().read([name])


# -- setting -------------------------------------------------------------------


class Vehicle:
    """Has parameters in the encoding of its stack; refuses what it is told to."""

    def __init__(self, autopilot: Autopilot, parameters: dict[str, float], kind: int) -> None:
        self.autopilot, self.parameters, self.kind = autopilot, parameters, kind
        self.refused: set[str] = set()
        self.lose = 0
        self.code: int | None = None

    def __call__(self, message):
        name = message.param_id
        if self.lose > 0:
            self.lose -= 1
            return []
        union = self.autopilot is PX4 and self.kind == INT32
        if message.get_type() == "PARAM_SET":
            if self.code is not None:
                return [error(name, self.code)]
            assert message.param_type == self.kind
            if name not in self.refused:
                raw = payload_of(message, 4)[:4]
                self.parameters[name] = struct.unpack("<i", raw)[0] if union else message.param_value
        number = self.parameters[name]
        return [bytewise(name, number) if union else value(name, number, self.kind)]


def known(vehicle: Vehicle, name: str) -> tuple[ParameterClient, Script]:
    client = ParameterClient()
    client.read([name])
    script = Script(client, vehicle.autopilot, vehicle)
    script.run(1.0)
    return client, script


@pytest.mark.parametrize(
    ("autopilot", "kind", "before", "after"),
    [
        (ARDUPILOT, INT8, 0, 6), (ARDUPILOT, REAL, 0.2, 0.35), (PX4, INT32, 0, 1), (PX4, INT32, 5, -1),
        (PX4, REAL, 0.1, 175.0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("lose", [0, 1, 2])
def test_set_and_read_back(autopilot, kind, before, after, lose):
    vehicle = Vehicle(autopilot, {"X": before}, kind)
    client, script = known(vehicle, "X")
    vehicle.lose = lose
    client.write("X", after)
    script.run(8.0)
    (written,) = client.take_written()
    assert written.accepted and written.value == pytest.approx(after, rel=1e-6)
    assert vehicle.parameters["X"] == pytest.approx(after, rel=1e-6)
    assert script.sent[-1][1].get_type() == "PARAM_REQUEST_READ"
    assert client.take_written() == [] and not client.busy


def test_refusal_tells_what_it_keeps():
    vehicle = Vehicle(ARDUPILOT, {"VISO_TYPE": 0}, INT8)
    client, script = known(vehicle, "VISO_TYPE")
    vehicle.refused.add("VISO_TYPE")
    client.write("VISO_TYPE", 1)
    script.run(6.0)
    (written,) = client.take_written()
    assert (written.accepted, written.value, written.why) == (False, 0, "it keeps 0")
    assert client.readings["VISO_TYPE"].value == 0


def test_refusal_by_an_error_message():
    vehicle = Vehicle(ARDUPILOT, {"VISO_TYPE": 0}, INT8)
    client, script = known(vehicle, "VISO_TYPE")
    vehicle.code = dialect.MAV_PARAM_ERROR_READ_ONLY
    client.write("VISO_TYPE", 1)
    script.run(0.2)
    (written,) = client.take_written()
    assert not written.accepted and "read-only" in written.why


def test_no_answer_is_not_success():
    vehicle = Vehicle(ARDUPILOT, {"VISO_TYPE": 0}, INT8)
    client, script = known(vehicle, "VISO_TYPE")
    vehicle.lose = 99
    client.write("VISO_TYPE", 1)
    script.run(6.0)
    (written,) = client.take_written()
    assert (written.accepted, written.value, written.why) == (False, None, "no answer")


def test_an_echo_alone_is_not_enough():
    """Echoed, but what is read back differs: the storage did not take it."""
    vehicle = Vehicle(ARDUPILOT, {"VISO_TYPE": 0}, INT8)
    client, script = known(vehicle, "VISO_TYPE")
    client.write("VISO_TYPE", 1)
    client.poll(script.now_ns, 7, ARDUPILOT)
    client.on_value(value("VISO_TYPE", 1.0, INT8), ARDUPILOT, script.now_ns)
    script.run(6.0)  # the vehicle itself never got it
    (written,) = client.take_written()
    assert (written.accepted, written.why) == (False, "it keeps 0")


def test_what_cannot_be_set_is_refused_before_sending():
    vehicle = Vehicle(ARDUPILOT, {"VISO_TYPE": 0}, INT8)
    client, _ = known(vehicle, "VISO_TYPE")
    for number, problem in ((math.nan, "finite"), (1.5, "whole"), (128, "-128 to 127")):
        with pytest.raises(ValueError, match=problem):
            client.write("VISO_TYPE", number)
    with pytest.raises(ValueError, match="not read"):
        client.write("EK3_ENABLE", 1)
    client.write("VISO_TYPE", 1)
    with pytest.raises(ValueError, match="while VISO_TYPE is"):
        client.write("VISO_TYPE", 0)
