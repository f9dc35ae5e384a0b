"""Both ends of a wire with damaged bytes on their way: the short form, and whatever comes in."""

import os
import random

import pytest
from scipy.stats import poisson

from drivers.protocol.definition import IDENTITY, MESSAGES
from drivers.protocol.records import Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, parts
from drivers.wires.wire import Arrival, Broken, More, Nak, Reply
from real_wires import damage
from sim.amplifier.simulated_amplifier import Amplifier
from virtual_lines import KINDS

DEFAULT_COUNT = 4000
COUNT = int(os.environ.get("FRAMES", DEFAULT_COUNT))  # `make fuzz` has a million
_DAMAGED = 0.25  # of all frames
SHAPE = Envelope(50, tuple((100 * knot, 10 * knot) for knot in range(20)))
LAYERS = [
    LayerSet(0, 20, 500, (Command(0, 2200, 2000, 0), Command(1, 5010, 9000, -9000, onset=SHAPE))),
    LayerSet(3, 0, 800, renew=True),
]
CUT = list(parts(pack_layers(LAYERS) + [0x0100, 10, 0] * 30, session=9, token=8, now=False))
REQUESTS: list[tuple[str, Values]] = [
    *(("Hello", {}), ("GetCaps", {}), ("GetStatus", {}), ("GetFaults", {}), ("GetMeasured", {})),
    *(("Arm", {"session": 9, "watchdog": 2000, "shift": 0}), ("Ping", {"session": 9, "rate": 0})),
    *(("Stop", {"ramp": 5}), ("Clear", {"latch": 1}), ("Disarm", {"ramp": 5})),
    *(("Commit", {"session": 9, "token": 7, "at": 0}), ("Silence", {"session": 9, "ramp": 5})),
    *(("GetAchieved", {"layer": 0}), ("GetReading", {"first": 0})),
    ("Set", parts(pack_layers(LAYERS), session=9, token=7, now=True)[0]),
    *(("Set", part) for part in CUT),
]


def is_in_range(name: str, arrival: Arrival) -> bool:
    """Whether the numbers of a reply are such as the protocol has."""
    if isinstance(arrival, Reply):
        record = IDENTITY if name == "Hello" else MESSAGES[name].reply
        return bool(record.pack(arrival.values))
    return True


class Recorded(Amplifier):
    """An amplifier whose requests are kept."""

    def __init__(self) -> None:
        super().__init__("a", channels=2)
        self.asked: list[tuple[str, Values]] = []

    def handle(self, name: str, values: Values, now: float) -> Values:
        self.asked.append((name, values))
        return super().handle(name, values, now)


@pytest.mark.parametrize("kind", ["serial", "rtu", "tcp"])
def test_damaged_frames_are_counted_and_change_nothing(kind: str) -> None:
    """Requests and replies damaged at random: no exception, and good ones are understood again.

    With a CRC of 16 bits nothing is carried out but what was sent, except by a chance of 1 in
    65 536, which the frames of the suite do not meet; over TCP nothing out of range.
    """
    chance = random.Random(7)
    wire, sent = KINDS[kind].wire(), list[bytes]()
    amplifier = Recorded()
    far_end = KINDS[kind].far_end({1: amplifier}, sent.append)
    now, replies, strange = 0.0, 0, 0

    def ask(name: str, values: Values, *, damaged: float) -> list[Arrival]:
        """What comes of a request whose frames are damaged with a probability."""
        data, arrivals = wire.request(1, name, values), list[Arrival]()
        while data:
            sent.clear()
            far_end.receive(damage(data, chance) if chance.random() < damaged else data, now)
            back = b"".join(sent)
            if back and chance.random() < damaged:
                back = damage(back, chance)
            came = wire.received(back)
            data = next((each.data for each in came if isinstance(each, More)), b"")
            arrivals += came
        wire.withdraw()
        return arrivals

    for _ in range(COUNT):
        name, values = chance.choice(REQUESTS)
        amplifier.asked.clear()
        arrivals = ask(name, values, damaged=_DAMAGED)
        assert all(is_in_range(name, arrival) for arrival in arrivals)
        assert sum(isinstance(each, Reply | Nak | Broken) for each in arrivals) <= 1
        replies += any(isinstance(each, Reply) for each in arrivals)
        for asked, numbers in amplifier.asked:
            assert MESSAGES[asked].request.pack(numbers) is not None
            strange += (asked, numbers) not in REQUESTS
        now += chance.choice((0.0, 0.0, 0.001, 0.02, 2.0))
    if kind != "tcp":
        assert strange == 0 or COUNT > DEFAULT_COUNT
        assert strange <= poisson.ppf(1 - 1e-6, _DAMAGED * COUNT / 65_536)
    assert replies > COUNT // 20
    assert wire.counters.invalid_frames + wire.counters.unexpected_frames > COUNT // 20
    now += 2.0
    ask("GetStatus", {}, damaged=0.0)
    assert isinstance(ask("GetStatus", {}, damaged=0.0)[-1], Reply)
