"""Which code wins where a request has several faults, by docs/reference/protocol.md#checks."""

import pytest

from drivers.codec.serial_line.frame import Frame, FrameReader, encode_frame
from drivers.protocol.table import REFUSALS, STATES
from sim.amplifier.contract import Amplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

NAK = 0x9F


class OnALine:
    """An amplifier on a serial line; state by the word of its status."""

    def __init__(self) -> None:
        self.amplifier = Amplifier("a", channels=2)
        self.replies: list[Frame] = []
        reader = FrameReader()
        self.end = SerialAmplifiers(
            {1: self.amplifier}, lambda data: self.replies.extend(reader.feed(data))
        )

    def ask(self, kind: int, payload: str, *, version: int = 3) -> Frame:
        """The reply to a request with these bytes, in hexadecimal."""
        self.replies.clear()
        self.end.receive(encode_frame(Frame(kind, 1, 9, bytes.fromhex(payload), version)), 0.0)
        return self.replies[-1]


@pytest.mark.parametrize(
    ("kind", "payload", "version", "code"),
    [
        (99, "00", 2, "UNSUPPORTED_VERSION"),  # also unknown, with half a word
        (99, "0000", 3, "UNKNOWN_TYPE"),
        (3, "0000", 3, "BAD_VALUE"),  # session 0, and a word is missing
        (3, "0100", 3, "BAD_LENGTH"),
        (3, "0100 FA00 0000", 3, "BAD_LENGTH"),
        (6, "0100 0000", 3, "BAD_TOKEN"),  # in the wrong state as well
        (6, "0100 0100", 3, "WRONG_STATE"),  # of another session as well
    ],
)
def test_first_fault_wins_while_disarmed(kind: int, payload: str, version: int, code: str) -> None:
    """Version, type, words, state."""
    reply = OnALine().ask(kind, payload, version=version)
    assert (reply.kind, reply.payload[2]) == (NAK, REFUSALS[code])


def test_session_wins_over_what_a_request_asks_for() -> None:
    """While armed by session 7: a set of session 8 that is cut short, an Arm of another host."""
    line = OnALine()
    line.ask(3, "0700 FA00")
    assert line.ask(5, "0800 0100 0200 0100").payload[2] == REFUSALS["WRONG_SESSION"]
    assert line.ask(5, "0700 0100 0200 0100").payload[2] == REFUSALS["BAD_LENGTH"]
    assert line.ask(3, "0800 D007").payload[2] == REFUSALS["WRONG_SESSION"]


@pytest.mark.parametrize(("kind", "state"), [(4, "SWITCH_ON_DISABLED"), (8, "QUICK_STOP_ACTIVE")])
def test_stop_and_disarm_are_not_refused_for_their_ramp(kind: int, state: str) -> None:
    """65.535 s counts as the longest ramp of 1 s, after which it is silent."""
    line = OnALine()
    line.ask(3, "0700 D007")
    line.ask(5, "0700 0100 0300 0100 0000 0000 0000 0008 1027 0000")  # level 1 at once
    assert line.ask(kind, "FFFF").kind == kind | 0x80
    line.amplifier.tick(0.5)
    assert line.amplifier.playback.level(0, 0.5) == pytest.approx(0.5)
    line.amplifier.tick(1.001)
    assert (line.amplifier.state, line.amplifier.playback.level(0, 1.0)) == (state, 0.0)
    assert line.amplifier.state in STATES


def test_echo_of_an_event_gets_no_reply() -> None:
    """Of an adapter that hears what it sends: neither Nak nor anything else."""
    line = OnALine()
    line.end.receive(encode_frame(Frame(30, 1, 9, bytes(8), 3)), 0.0)
    assert line.replies == []
