"""A host and an amplifier on a serial line, whose frames of protocol 4 are written by hand.

By docs/decisions/0088-protocol-4.md, with none of the product's codecs: a frame is 00, COBS of
(type, version, address, sequence as u16, payload, CRC-32), 00; words are little-endian.
"""

import struct
import zlib
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from cobs import cobs

from era_haptics.lab.witness.capture import (
    AmplifierConfig,
    ChannelLimits,
    TimeLimits,
    WitnessConfig,
)
from plate_witness import PlateWitness

VERSION = 4
REPLY = 0x80
HELLO, GET_CAPS, ARM, DISARM, SET, COMMIT, SILENCE, STOP = 1, 2, 3, 4, 5, 6, 7, 8
GET_STATUS, GET_FAULTS, CLEAR, PING, GET_ACHIEVED, NAK, EVENT = 9, 10, 11, 12, 13, 31, 30
SET_ADDRESS, MARK = 15, 19
SWITCHED_OFF, SWITCHED_ON, ENABLED, STOPPED, REACTING, FAULT = 1, 3, 4, 5, 6, 7
WATCHDOG, ARC = 1, 4
"""Faults, by their numbers."""


def frame(
    kind: int, words: Sequence[int] = (), *, sequence: int, address: int = 1, version: int = VERSION
) -> bytes:
    """Return a frame with words as its payload; negative ones in two's complement."""
    payload = struct.pack(f"<{len(words)}H", *(word % 65536 for word in words))
    return raw_frame(kind, payload, sequence=sequence, address=address, version=version)


def raw_frame(
    kind: int, payload: bytes, *, sequence: int, address: int = 1, version: int = VERSION
) -> bytes:
    """Return a frame with a payload of bytes."""
    body = struct.pack("<BBBH", kind, version, address, sequence) + payload
    stuffed: bytes = cobs.encode(body + struct.pack("<L", zlib.crc32(body)))
    return b"\0" + stuffed + b"\0"


def identity(*, serial: str = "7") -> bytes:
    """Return the payload of the reply to Hello: versions (bit 4), four texts with their lengths."""
    texts = b"".join(bytes([len(text)]) + text.encode() for text in ("v", "p", serial, "1"))
    return struct.pack("<H", 1 << 4) + texts


def status(
    state: int = ENABLED,
    *,
    fault: int = 0,
    high_voltage: bool | None = None,
    limited: bool = False,
    latch: int = 0,
    left: int = 250,
    clock: int = 0,
    token: int = 0,
    levels: Sequence[int] = (0, 0),
    tokens: Sequence[int] = (0, 0, 0, 0),
) -> list[int]:
    """Return the words of a status: of two channels and four layers, at 25 degrees and 1800 V."""
    is_driven = state in (ENABLED, SWITCHED_ON) or (state == STOPPED and any(levels))
    is_on = is_driven if high_voltage is None else high_voltage
    counts = len(levels) << 8 | len(tokens)
    flags = is_on | limited << 2
    head = [state, fault, flags, latch, left if state == ENABLED else 0, 250, 1800]
    return [*head, clock >> 16, clock & 0xFFFF, token, counts, *levels, *tokens]


def capabilities(*, layers: int = 4) -> list[int]:
    """Return the words of capabilities of two channels: every range as wide as it may be."""
    general = [
        2,
        layers,
        8,
        512,
        32,
        2,
        200,
        65535,
        1,
        10000,
        1,
        1,
        1000,
        65535,
        100,
        2000,
        1,
        1000,
        20,
    ]
    return [*general, *(200, 65535, 10000) * 2]


def tone(
    channel: int, frequency: float, level: float, phase: float = 0.0, *, keep_phase: bool = False
) -> list[int]:
    """Return the words of a command without envelopes, in Hz, full levels and degrees."""
    head = channel << 4 | keep_phase << 3
    return [head, round(frequency * 20), round(level * 10000), round(phase * 100)]


def layer(
    number: int,
    *commands: Sequence[int],
    ramp: int = 10,
    valid_for: int = 0,
    after: bool = False,
    renew: bool = False,
) -> list[int]:
    """Return the words of a layer of a set; ramp, valid_for [ms]."""
    head = number << 7 | after << 6 | renew << 5 | len(commands)
    return [head, ramp, valid_for, *(word for command in commands for word in command)]


def part(
    token: int, *layers: Sequence[int], session: int = 9, index: int = 0, parts: int = 1,
    now: bool = False,
) -> list[int]:  # fmt: skip
    """Return the words of a Set with these words of its stream."""
    head = [session, token, index << 8 | parts << 1 | now]
    return [*head, *(word for each in layers for word in each)]


def taken(
    token: int, *, staged: bool = True, played: bool = False, exact: bool = True, missing: int = 0
) -> list[int]:
    """Return the words of the reply to a Set."""
    return [token, exact << 2 | staged << 1 | played, missing]


TOOK = 0.001  # s; from a request to its reply
HALF: dict[str, Any] = {"token": 5, "levels": (5000, 0), "tokens": (5, 0, 0, 0)}
"""The status of 0.5 on channel 0."""


class Talk:
    """Requests and replies of one or two amplifiers; time [s], one clock for all.

    limits: of the channels; expected: what every pattern of the first must be on its channel 0.
    """

    def __init__(
        self,
        *,
        names: Sequence[str] = ("m",),
        expected: Sequence[tuple[float, float, float]] | None = None,
        **limits: Any,
    ) -> None:
        of_all = ChannelLimits(**{"frequency": (40, 500), "level": 0.8, **limits})
        amplifiers = {
            name: AmplifierConfig("a", address, {0: of_all, 1: of_all})
            for address, name in enumerate(names, 1)
        }
        times = TimeLimits(slack=0.002, heartbeat=3.0)
        self.config = WitnessConfig({"a": "serial"}, amplifiers, times)
        self.capture: list[str] = []
        self.witness = PlateWitness(self.config, record=self.capture.append)
        if expected is not None:
            self.witness.expect({names[0]: {0: list(expected)}})
        self.time = 1.0
        self.sequence = 0
        self.latch = 0

    @property
    def found(self) -> list[str]:
        """The rules that were found broken."""
        return [one.invariant for one in self.witness.finish(self.time)]

    def rest(self, seconds: float) -> "Talk":
        """Let time pass."""
        self.time += seconds
        return self

    def told(self, what: str, *arguments: Any, **named: Any) -> "Talk":
        """Let the witness be told something by a method of its own, now."""
        getattr(self.witness, what)(self.time, *arguments, **named)
        return self

    def told_of(self, what: str) -> "Talk":
        """Let the host have opened the wire, whose amplifiers it does not know then, or closed."""
        getattr(self.witness, what)("a", self.time)
        return self

    def numbered(self, sequence: int) -> "Talk":
        """Let what comes next belong to the request of this number."""
        self.sequence = sequence
        return self

    def sends(self, kind: int, words: Sequence[int] = (), *, address: int = 1) -> "Talk":
        """Let the host send a request now."""
        self.sequence += 1
        version = 0 if kind == HELLO else VERSION
        return self.host_bytes(
            frame(kind, words, sequence=self.sequence, address=address, version=version)
        )

    def replies(self, kind: int, words: Sequence[int] = (), *, address: int = 1) -> "Talk":
        """Let the amplifier reply to the last request now."""
        data = frame(kind | REPLY, words, sequence=self.sequence, address=address)
        self.amplifier_bytes(data)
        return self

    def host_bytes(self, data: bytes, *, flipped: int | None = None) -> "Talk":
        """Let bytes pass toward the amplifier; flipped: the byte whose lowest bit is another."""
        damaged = bytearray(data)
        if flipped is not None:
            damaged[flipped] ^= 1
        self.witness.record_bytes("a", "amplifier", self.time, bytes(damaged))
        return self

    def amplifier_bytes(self, data: bytes) -> None:
        """Let bytes pass toward the host."""
        self.witness.record_bytes("a", "host", self.time, data)

    def exchange(
        self, kind: int, words: Sequence[int], reply: Sequence[int], *, address: int = 1
    ) -> "Talk":
        """Let a request have its reply, 1 ms later."""
        self.sends(kind, words, address=address)
        self.rest(TOOK).replies(kind, reply, address=address)
        return self.rest(TOOK)

    def refused(self, kind: int, words: Sequence[int], code: int, *, address: int = 1) -> "Talk":
        """Let a request be refused."""
        self.sends(kind, words, address=address)
        self.rest(TOOK).replies(NAK, (kind, code, 255), address=address)
        return self.rest(TOOK)

    def identified(self, state: int = SWITCHED_OFF, *, latch: int = 0, address: int = 1) -> "Talk":
        """Let an amplifier identify itself in a state, disarmed."""
        self.sends(HELLO, address=address)
        kind = HELLO | REPLY
        self.rest(TOOK).amplifier_bytes(
            raw_frame(kind, identity(), sequence=self.sequence, address=address, version=0)
        )
        self.exchange(GET_CAPS, (), capabilities(), address=address)
        return self.exchange(GET_STATUS, (), status(state, latch=latch), address=address)

    def armed(self, *, address: int = 1) -> "Talk":
        """Let it be identified and armed: session 9, watchdog 250 ms."""
        self.identified(address=address)
        return self.exchange(ARM, (9, 250, 0), status(), address=address)

    def staged(self, token: int, *layers: Sequence[int], address: int = 1) -> "Talk":
        """Let a set be staged."""
        return self.exchange(SET, part(token, *layers), taken(token), address=address)

    def committed(self, token: int, *, address: int = 1, **fields: Any) -> "Talk":
        """Let a set be committed; fields: of the status in the reply."""
        reply = status(token=token, **fields)
        return self.exchange(COMMIT, (9, token, 0), reply, address=address)

    def playing(self, token: int = 5, level: float = 0.5) -> "Talk":
        """Let 100 Hz play at a level on channel 0 in layer 0, and settle."""
        self.staged(token, layer(0, tone(0, 100, level)))
        self.committed(token, tokens=(token, 0, 0, 0))
        return self.rest(0.03)

    def fed(self, beats: int) -> "Talk":
        """Let so many heartbeats pass, 0.2 s apart."""
        for _ in range(beats):
            self.rest(0.2).says()
        return self

    def says(self, state: int = ENABLED, *, kind: int = PING, **fields: Any) -> "Talk":
        """Let it be asked, by Ping unless told otherwise, and say how it is."""
        words = (9, 0) if kind == PING else ()
        return self.exchange(kind, words, status(state, **fields))


Broken: TypeAlias = dict[str, tuple[str, Callable[[], Talk]]]
"""Conversations by name, each with the one rule that it breaks."""
