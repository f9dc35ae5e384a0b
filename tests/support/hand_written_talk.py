"""A host and an amplifier on a serial line, written by hand, before a witness of protocol 4."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import hand_written as hand
from era_haptics.lab.witness.capture import (
    AmplifierConfig,
    ChannelLimits,
    TimeLimits,
    WitnessConfig,
)
from plate_witness import PlateWitness

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
        version = 0 if kind == hand.HELLO else hand.VERSION
        return self.host_bytes(
            hand.frame(kind, words, sequence=self.sequence, address=address, version=version)
        )

    def replies(self, kind: int, words: Sequence[int] = (), *, address: int = 1) -> "Talk":
        """Let the amplifier reply to the last request now."""
        data = hand.frame(kind | hand.REPLY, words, sequence=self.sequence, address=address)
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
        self.rest(TOOK).replies(hand.NAK, (kind, code, 255), address=address)
        return self.rest(TOOK)

    def identified(
        self, state: int = hand.SWITCHED_OFF, *, latch: int = 0, address: int = 1
    ) -> "Talk":
        """Let an amplifier identify itself in a state, disarmed."""
        self.sends(hand.HELLO, address=address)
        kind = hand.HELLO | hand.REPLY
        self.rest(TOOK).amplifier_bytes(
            hand.raw_frame(
                kind, hand.identity(), sequence=self.sequence, address=address, version=0
            )
        )
        self.exchange(hand.GET_CAPS, (), hand.capabilities(), address=address)
        return self.exchange(hand.GET_STATUS, (), hand.status(state, latch=latch), address=address)

    def armed(self, *, address: int = 1) -> "Talk":
        """Let it be identified and armed: session 9, watchdog 250 ms."""
        self.identified(address=address)
        return self.exchange(hand.ARM, (9, 250, 0), hand.status(), address=address)

    def staged(self, token: int, *layers: Sequence[int], address: int = 1) -> "Talk":
        """Let a set be staged."""
        return self.exchange(
            hand.SET, hand.part(token, *layers), hand.taken(token), address=address
        )

    def committed(self, token: int, *, address: int = 1, **status: Any) -> "Talk":
        """Let a set be committed; status: as in the reply."""
        reply = hand.status(token=token, **status)
        return self.exchange(hand.COMMIT, (9, token, 0), reply, address=address)

    def playing(self, token: int = 5, level: float = 0.5) -> "Talk":
        """Let 100 Hz play at a level on channel 0 in layer 0, and settle."""
        self.staged(token, hand.layer(0, hand.tone(0, 100, level)))
        self.committed(token, tokens=(token, 0, 0, 0))
        return self.rest(0.03)

    def fed(self, beats: int) -> "Talk":
        """Let so many heartbeats pass, 0.2 s apart."""
        for _ in range(beats):
            self.rest(0.2).says()
        return self

    def says(self, state: int = hand.ENABLED, *, kind: int = hand.PING, **status: Any) -> "Talk":
        """Let it be asked, by Ping unless told otherwise, and say how it is."""
        words = (9, 0) if kind == hand.PING else ()
        return self.exchange(kind, words, hand.status(state, **status))


Broken: TypeAlias = dict[str, tuple[str, Callable[[], Talk]]]
"""Conversations by name, each with the one rule that it breaks."""
