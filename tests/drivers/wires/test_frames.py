"""A request and its reply on every wire, byte by byte, and frames that are damaged at random.

Bytes were worked out by hand from docs/reference; checksums are zlib's and minimalmodbus's, and
COBS is that of the package `cobs`.
"""

import os
import random
from unittest.mock import Mock

import pytest
from scipy.stats import poisson

from drivers.protocol.definition import IDENTITY, MESSAGES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, parts
from drivers.wires.modbus import ModbusWire
from drivers.wires.wire import Arrival, BrokenReply, Continuation, Nak, Reply, Wire
from kit.clock import KINDS
from kit.wires import damage
from sim.amplifier.simulated_amplifier import SimulatedAmplifier

PART: Values = {
    "session": 0x2A17,
    "token": 0x0102,
    "index": 0,
    "parts": 1,
    "now": 1,
    "stream": [0x01A0, 0, 800],
}
"""A Set that is played immediately: layer 3 is renewed for 800 ms."""
REPLY: Values = {"token": 0x0102, "exact": 1, "staged": 0, "played": 1, "missing": 0}


def test_set_and_its_reply_have_the_bytes_of_the_specification_over_modbus_rtu() -> None:
    """The read of the reply is sent after the response to the write."""
    wire = ModbusWire(115_200, is_rtu=True, number=0)
    write = "01 10 0500 0007 0E 0001 2A17 0102 0003 01A0 0000 0320 E774"
    write_response = "01 10 0500 0007 8107"
    read = "01 04 0580 0005 312D"
    read_response = "01 04 0A 0001 0000 0102 0005 0000 B4FD"

    assert wire.request(1, "Set", PART) == bytes.fromhex(write)
    assert wire.received(bytes.fromhex(write_response)) == [Continuation(bytes.fromhex(read))]
    assert wire.received(bytes.fromhex(read_response)) == [Reply(REPLY)]


# Damaged frames

DEFAULT_COUNT = 4000
COUNT = int(os.environ.get("FRAMES", DEFAULT_COUNT))
"""Number of requests; `make fuzz` sends a million."""
DAMAGED = 0.25
"""Share of the frames that are damaged."""
ENVELOPE = Envelope(50, tuple((100 * knot, 10 * knot) for knot in range(20)))
TONES = (Command(0, 2200, 2000, 0), Command(1, 5010, 9000, -9000, onset=ENVELOPE))
LAYERS = [LayerSet(0, 20, 500, TONES), LayerSet(3, 0, 800, renew=True)]
LONG_SET = parts(pack_layers(LAYERS) + [0x0100, 10, 0] * 30, session=9, token=8, now=False)
REQUESTS: list[tuple[str, Values]] = [
    ("Hello", {}),
    ("GetCaps", {}),
    ("GetStatus", {}),
    ("GetFaults", {}),
    ("GetMeasured", {}),
    ("GetAchieved", {"layer": 0}),
    ("Arm", {"session": 9, "watchdog": 2000, "shift": 0}),
    ("Ping", {"session": 9, "rate": 0}),
    ("Stop", {"ramp": 5}),
    ("Clear", {"latch": 1}),
    ("Disarm", {"ramp": 5}),
    ("Commit", {"session": 9, "token": 7, "at": 0}),
    ("Silence", {"session": 9, "ramp": 5}),
    ("Set", parts(pack_layers(LAYERS), session=9, token=7, now=True)[0]),
    *(("Set", part) for part in LONG_SET),
]


class DamagedLine:
    """A line to a simulated amplifier on which frames are damaged in both directions."""

    def __init__(self, kind: str, rng: random.Random) -> None:
        self.rng = rng
        self.wire: Wire = KINDS[kind].wire()
        self.sent: list[bytes] = []
        amplifier = SimulatedAmplifier("a", channels=2)
        self.handle = Mock(side_effect=amplifier.handle)
        amplifier.handle = self.handle  # type: ignore[method-assign]
        self.far_end = KINDS[kind].far_end({1: amplifier}, self.sent.append)

    def exchange(self, name: str, values: Values, now: float, share: float) -> list[Arrival]:
        """Send a request at a time [s]; return what arrives if a share of frames is damaged."""
        data = self.wire.request(1, name, values)
        arrivals: list[Arrival] = []
        while data:
            self.sent.clear()
            self.far_end.receive(self._transmit(data, share), now)
            reply = b"".join(self.sent)
            received = self.wire.received(self._transmit(reply, share) if reply else b"")
            arrivals += received
            data = b""
            for arrival in received:
                if isinstance(arrival, Continuation):
                    data = arrival.data
                    break
        self.wire.withdraw()
        return arrivals

    def _transmit(self, data: bytes, share: float) -> bytes:
        return damage(data, self.rng) if self.rng.random() < share else data


@pytest.mark.parametrize("kind", ["serial", "rtu", "tcp"])
def test_damaged_frames_are_counted_and_have_no_effect(kind: str) -> None:
    """Nothing raises, and intact frames are understood again.

    With a CRC of 16 bits only requests that were sent are carried out, except for 1 of 65 536
    damaged frames, which does not occur in `make test`; over TCP nothing out of range is.
    """
    rng = random.Random(7)
    line = DamagedLine(kind, rng)
    now = 0.0
    replies = 0
    unknown_requests = 0

    for _ in range(COUNT):
        name, values = rng.choice(REQUESTS)
        line.handle.reset_mock()
        arrivals = line.exchange(name, values, now, DAMAGED)
        record = IDENTITY if name == "Hello" else MESSAGES[name].reply
        answers = [item for item in arrivals if isinstance(item, Reply | Nak | BrokenReply)]
        assert len(answers) <= 1
        for answer in answers:
            if isinstance(answer, Reply):
                assert record.pack(answer.values)  # in range
                replies += 1
        for call in line.handle.call_args_list:
            handled_name, handled_values = call.args[:2]
            assert MESSAGES[handled_name].request.pack(handled_values) is not None  # in range
            unknown_requests += (handled_name, handled_values) not in REQUESTS
        now += rng.choice((0.0, 0.0, 0.001, 0.02, 2.0))

    if kind != "tcp":
        assert unknown_requests == 0 or COUNT > DEFAULT_COUNT
        assert unknown_requests <= poisson.ppf(1 - 1e-6, DAMAGED * COUNT / 65_536)
    assert replies > COUNT // 20
    counters = line.wire.counters
    assert counters.invalid_frames + counters.unexpected_frames > COUNT // 20
    now += 2.0
    line.exchange("GetStatus", {}, now, 0.0)
    assert isinstance(line.exchange("GetStatus", {}, now, 0.0)[-1], Reply)
