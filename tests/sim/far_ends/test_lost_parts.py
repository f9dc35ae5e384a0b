"""Sets in up to eight parts on every wire, with every tenth message lost, either way.

The host is written by hand from docs/decisions/0088: it sends all parts without a pause, repeats
the last one alone where no reply comes, and goes on from the part that is said to be missing.
"""

import random
import struct
from collections.abc import Sequence
from typing import Any

import pytest

from drivers.protocol.records import Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from drivers.protocol.table import MESSAGES, NAK
from drivers.wires.can_bus.canopen import CANOPEN, CanFrame, cob_id
from drivers.wires.can_bus.frames import pack_frames
from drivers.wires.modbus.frames import BOX, REPLY, read_pdu
from judged_line import CLIENTS, KINDS
from long_form import shortly
from sim.amplifier.contract import Amplifier
from words_line import KINDS as WIRES

LOST = 0.1
SESSION, TURN = 9, 0.004
CHANNELS = 4


class Noted(Amplifier):
    """An amplifier that notes the tokens of the sets that begin to play."""

    def _play(self, layers: tuple[LayerSet, ...], token: int, now: float) -> None:
        self.begun: list[int] = [*getattr(self, "begun", ()), token]
        super()._play(layers, token, now)


class Line:
    """A wire of a kind to one amplifier, on which messages are lost; time [s] goes by turns."""

    def __init__(self, kind: str, seed: int) -> None:
        self.chance, self.time = random.Random(seed), 0.0
        self.far = Noted("a", channels=CHANNELS)
        self.client: Any = CLIENTS[kind](1)
        self.is_modbus = kind in ("rtu", "tcp")
        self.loses = 0.0
        self._end = WIRES[kind].far_end({1: self.far}, self._reply)
        if kind == "can":
            start = CanFrame(cob_id("nmt"), bytes([CANOPEN["nmt"]["start"], 1]))
            self._end.receive(pack_frames([start]), 0.0)

    def _reply(self, data: bytes) -> None:
        if self.chance.random() >= self.loses:
            self.client.hear(data)

    def put(self, data: bytes) -> list[Any]:
        """Send bytes; returns the messages that come back."""
        self.client.heard.clear()
        self.time += TURN
        if self.chance.random() >= self.loses:
            self._end.receive(data, self.time)
        return [*self.client.heard]

    def send(self, name: str, **values: Any) -> Values | None:
        """Send a request; returns the values of its reply, if that comes."""
        message = MESSAGES[name]
        data = self.client.request(message.number, message.request.pack(values))
        heard = self.put(data)
        if self.is_modbus:
            if name == "Set" and values["index"] < values["parts"] - 1:
                while not heard:  # each write has its response
                    heard = self.put(data)
                return None
            tag = self.client.number
            count = 2 + 3 if name == "Set" else 30
            read = self.client.adu(read_pdu(BOX * message.number + REPLY, count))
            for each in self.put(read) if heard else ():
                words = struct.unpack(f">{count}H", each.frame[1][2:])
                if words[0] == tag:
                    assert words[1] == 0
                    return message.reply.unpack(words[2:], is_strict=False)
            return None
        for each in heard:
            assert each.type & 0x7F != NAK
            if each.type & 0x7F == message.number and each.number == self._number:
                return message.reply.unpack(each.words, is_strict=False)
        return None

    @property
    def _number(self) -> int:
        return int(getattr(self.client, "sequence", self.client.__dict__.get("number", 0)))

    def play(self, cut: Sequence[Values]) -> str:
        """Send a set in its parts until it is said to be staged or played; returns which."""
        *others, last = cut
        first = 0
        while True:
            for part in others[first:]:
                assert self.send("Set", **part) is None
            taken = None
            while taken is None:
                taken = self.send("Set", **last)
            assert taken["token"] == last["token"]
            if taken["played"] or taken["staged"]:
                return "played" if taken["played"] else "staged"
            first = taken["missing"]

    def ask(self, name: str, **values: Any) -> Values:
        """Send a request until it has its reply."""
        while (reply := self.send(name, **values)) is None:
            pass
        return reply


def levels_of(token: int) -> list[int]:
    """The levels of a set on the channels, which no other set within reach has."""
    return [(token * 37 + 1000 * channel) % 9973 + 1 for channel in range(CHANNELS)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sets", shortly([150, 20_000], [150]))
def test_every_set_plays_whole_and_once(kind: str, sets: int) -> None:
    """Whatever is lost: each is said to play, begins once, and with the levels of all its parts."""
    line = Line(kind, seed=3)
    status = line.ask("Arm", session=SESSION, watchdog=2000, shift=0)
    line.loses = LOST
    for number in range(1, sets + 1):
        token = (number - 1) % 65535 + 1
        levels = levels_of(token)
        tones = [Command(channel, 2000, level, 0) for channel, level in enumerate(levels)]
        layers = LayerSet(0, 0, 0, tuple(tones[:2])), LayerSet(1, 0, 0, tuple(tones[2:]))
        stream = pack_layers(layers)
        count = line.chance.randrange(1, 9)
        now = line.chance.random() < 0.5
        width = -(-len(stream) // count)
        cut = parts(stream, session=SESSION, token=token, now=now, max_words=width)
        said = line.play(cut)
        assert said == ("played" if now else "staged")
        if not now:
            present = status["clock"] >> 16  # or somewhat later
            status = line.ask("Commit", session=SESSION, token=token, at=present)
            assert status["token"] == token
        status = line.ask("Ping", session=SESSION, rate=0)
        assert (status["token"], status["levels"]) == (token, levels)
    assert line.far.begun == [(each - 1) % 65535 + 1 for each in range(1, sets + 1)]
