"""A host and an amplifier on a serial line, whose frames of protocol 4 are written by hand.

According to docs/reference/protocol.md, with none of the product's codecs: a frame is 00, COBS of
(type, version, address, sequence as u16, payload, CRC-32), 00; words are little-endian. What a host
or an amplifier must not do is a conversation each.
"""

import struct
import zlib
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from cobs import cobs

from kit.witness import PlateWitness
from witness.capture import (
    AmplifierConfig,
    ChannelLimits,
    TimeLimits,
    WitnessConfig,
)

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
        self.witness = PlateWitness(self.config)
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

LOUD = layer(0, tone(0, 100, 0.5))
ABOVE: dict[str, Any] = {"token": 6, "tokens": (5, 6, 0, 0)}
"""Layers of 0.7 each at one channel."""

BROKEN: Broken = {
    "state_that_is_none": ("garbage", lambda: Talk().armed().says(9)),
    "set_accepted_before_arm": ("enabled", lambda: Talk().identified().staged(5, layer(0))),
    "present_clock_in_place_of_a_mark": (  # 0.15 s are 32.2 million steps
        "clock",
        lambda: Talk().armed().sends(MARK, address=0).rest(0.15).says(clock=32_212_000),
    ),
    "refused_though_staged": (
        "commit",
        lambda: Talk().armed().staged(5, layer(0)).refused(COMMIT, (9, 5, 0), 6),
    ),
    "another_session_feeds": (
        "session",
        lambda: Talk().armed().exchange(PING, (8, 0), status()),
    ),
    "reports_another_set": ("token", lambda: Talk().armed().playing().says(**HALF | {"token": 4})),
    "reports_another_set_of_a_layer": (
        "token",
        lambda: Talk().armed().playing().says(**HALF | {"tokens": (0, 5, 0, 0)}),
    ),
    "stop_refused": ("stop", lambda: Talk().armed().refused(STOP, (5,), 7)),
    "arms_itself": ("armed", lambda: Talk().identified().rest(0.1).says(kind=GET_STATUS)),
    "reply_of_another_set": (
        "credit",
        lambda: Talk().armed().exchange(SET, part(5, layer(0)), taken(4)),
    ),
    "no_watchdog": (
        "watchdog",
        lambda: Talk().armed().rest(0.3).says(kind=GET_STATUS, left=0),
    ),
    "watchdog_left_of_before": (
        "watchdog",
        lambda: Talk().armed().rest(0.05).says(kind=GET_STATUS, left=250),
    ),
    "stop_without_a_latch": (
        "latched",
        lambda: Talk().armed().exchange(STOP, (5,), status(STOPPED)),
    ),
    "latch_that_changes_by_itself": ("latched", lambda: Talk().armed().says(latch=1)),
    "switched_on_by_itself": ("state", lambda: Talk().armed().says(SWITCHED_ON)),
    "fault_without_a_cause": ("state", lambda: Talk().armed().says(FAULT, latch=1)),
    "address_set_while_armed": (
        "state",
        lambda: Talk().armed().exchange(SET_ADDRESS, (2, 1, 0x3700), status()),
    ),
    "another_level": (
        "plays",
        lambda: Talk().armed().playing().says(**HALF | {"levels": (4000, 0)}),
    ),
    "limited_below_full_level": (
        "plays",
        lambda: Talk().armed().playing().says(**HALF, limited=True),
    ),
    "other_capabilities": (
        "constant",
        lambda: Talk().armed().exchange(GET_CAPS, (), capabilities(layers=5)),
    ),
    "high_voltage_in_a_fault": (
        "high_voltage",
        lambda: (
            Talk()
            .armed()
            .says(FAULT, fault=ARC, latch=1)
            .rest(0.03)
            .says(FAULT, fault=ARC, latch=1, high_voltage=True)
        ),
    ),
    "staged_before_all_parts": (
        "commit",
        lambda: Talk().armed().exchange(SET, part(5, LOUD[4:], index=1, parts=2), taken(5)),
    ),
    "missing_though_all_came": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .sends(SET, part(5, LOUD[:4], parts=2))
            .exchange(
                SET,
                part(5, LOUD[4:], index=1, parts=2),
                taken(5, staged=False, exact=False),
            )
        ),
    ),
    "part_replied_to": (
        "credit",
        lambda: Talk().armed().exchange(SET, part(5, LOUD[:4], parts=2), taken(5, staged=False)),
    ),
    "exact_though_not_whole": (
        "plays",
        lambda: (
            Talk()
            .armed()
            .exchange(
                SET,
                part(5, LOUD[4:], index=1, parts=2),
                taken(5, staged=False),
            )
        ),
    ),
    "played_before_its_moment": (
        "silent",
        lambda: (
            Talk()
            .armed()
            .staged(5, LOUD)
            .exchange(COMMIT, (9, 5, 1000), status(token=5))
            .rest(0.1)
            .says(token=5, levels=(5000, 0))
        ),
    ),
    "not_played_at_its_moment": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .staged(5, LOUD)
            .exchange(COMMIT, (9, 5, 100), status(token=5))
            .rest(0.2)
            .says(token=5, tokens=(5, 0, 0, 0))
        ),
    ),
    "played_before_its_commit": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .exchange(
                SET,
                part(5, layer(0)),
                taken(5, staged=False, played=True),
            )
        ),
    ),
    "whole_and_not_staged": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .exchange(
                SET,
                part(5, layer(0)),
                taken(5, staged=False, exact=False),
            )
        ),
    ),
    "broadcast_commit_ignored": (
        "commit",
        lambda: (
            Talk().armed().staged(5, LOUD).sends(COMMIT, (9, 5, 0), address=0).says(kind=GET_STATUS)
        ),
    ),
    "plays_as_before": (
        "commit",
        lambda: (
            Talk()
            .armed()
            .playing()
            .staged(6, layer(0, tone(0, 100, 0.3)))
            .committed(6, levels=(5000, 0), tokens=(6, 0, 0, 0))
            .rest(0.03)
            .says(**HALF | {"token": 6, "tokens": (6, 0, 0, 0)})
        ),
    ),
    "ended_by_itself_too_late": (
        "token",
        lambda: (
            Talk()
            .armed()
            .staged(5, layer(0, tone(0, 100, 0.0005), valid_for=50))
            .committed(5, tokens=(5, 0, 0, 0))
            .rest(0.1)
            .says(token=5, tokens=(5, 0, 0, 0))
        ),
    ),
    "commit_of_a_set_of_long_ago": (
        "token",
        lambda: Talk().armed().staged(5, layer(0)).fed(6).committed(5),
    ),
    "older_set_accepted": (
        "token",
        lambda: (
            Talk()
            .armed()
            .playing()
            .told("faults", "a", are_on=True)  # which excuses the host alone
            .numbered(99)
            .host_bytes(frame(SET, part(4, layer(0)), sequence=99))
            .rest(0.001)
            .replies(SET, taken(4))
        ),
    ),
    "broadcast_stop_ignored": (
        "stop",
        lambda: Talk().armed().sends(STOP, (5,), address=0).says(kind=GET_STATUS),
    ),
    "reply_twice": (
        "credit",
        lambda: Talk().armed().says().replies(PING, status()),
    ),
    "no_reply": ("answer", lambda: Talk().armed().sends(GET_STATUS).rest(0.04)),
    "watchdog_too_early": (
        "watchdog",
        lambda: Talk().armed().rest(0.2).says(FAULT, kind=GET_STATUS, fault=WATCHDOG, latch=1),
    ),
    "stop_ends_by_itself": (
        "latched",
        lambda: (
            Talk()
            .armed()
            .exchange(STOP, (5,), status(STOPPED, latch=1))
            .rest(0.1)
            .says(SWITCHED_OFF, kind=GET_STATUS, latch=1)
        ),
    ),
    "cleared_by_another_latch": (
        "latched",
        lambda: (
            Talk()
            .armed()
            .exchange(STOP, (5,), status(STOPPED, latch=1))
            .rest(0.1)
            .exchange(CLEAR, (7,), status(SWITCHED_OFF, latch=1))
        ),
    ),
    "armed_in_a_fault": (
        "latched",
        lambda: (
            Talk()
            .armed()
            .says(FAULT, fault=ARC, latch=1)
            .exchange(ARM, (8, 250, 0), status(latch=1))
        ),
    ),
    "without_a_ramp": (
        "ramp",
        lambda: (
            Talk()
            .armed()
            .staged(5, layer(0, tone(0, 100, 0.5), ramp=100))
            .committed(5, levels=(5000, 0), tokens=(5, 0, 0, 0))
        ),
    ),
    "another_frequency_in_achieved": (
        "plays",
        lambda: (
            Talk().armed().playing().exchange(GET_ACHIEVED, (0,), [5, *layer(0, tone(0, 50, 0.5))])
        ),
    ),
    "another_channel_in_achieved": (
        "commit",
        lambda: (
            Talk().armed().playing().exchange(GET_ACHIEVED, (0,), [5, *layer(0, tone(1, 100, 0.5))])
        ),
    ),
    "not_exact_without_a_reason": (
        "plays",
        lambda: Talk().armed().exchange(SET, part(5, LOUD), taken(5, exact=False)),
    ),
    "not_limited_above_full_level": (
        "plays",
        lambda: (
            Talk(level=1.5)
            .armed()
            .playing(level=0.7)
            .staged(6, layer(1, tone(0, 150, 0.7)))
            .exchange(COMMIT, (9, 6, 0), status(levels=(7000, 0), **ABOVE))
            .rest(0.03)
            .says(levels=(10000, 0), **ABOVE)
            .rest(0.11)
            .says(levels=(10000, 0), **ABOVE)
        ),
    ),
    "plays_on_after_silence": (
        "silent",
        lambda: (
            Talk()
            .armed()
            .playing()
            .exchange(SILENCE, (9, 10), status(token=5, levels=(5000, 0)))
            .rest(0.02)
            .says(token=5, levels=(5000, 0))
        ),
    ),
    "fault_not_listed": (
        "faults",
        lambda: Talk().armed().says(FAULT, fault=ARC, latch=1).exchange(GET_FAULTS, (), (0,)),
    ),
    "fault_five_seconds_old": (
        "faults",
        lambda: (
            Talk()
            .armed()
            .says(FAULT, fault=ARC, latch=1)
            .exchange(GET_FAULTS, (), (1, ARC, 255, 0, 5000))
        ),
    ),
    "damaged_frame_carried_out": (
        "damage",
        lambda: (
            Talk()
            .armed()
            .told("faults", "a", are_on=True)
            .numbered(77)
            .host_bytes(frame(PING, (9, 0), sequence=77), flipped=-3)
            .rest(0.001)
            .replies(PING, status())
        ),
    ),
}
"""Conversations by what is wrong, each with the rule that it breaks."""

HOST_VIOLATIONS_BROKEN: Broken = {
    "set_of_520_hz": (
        "limits",
        lambda: Talk().armed().staged(5, layer(0, tone(0, 520, 0.5))),
    ),
    "set_above_the_level": (
        "limits",
        lambda: Talk().armed().staged(5, layer(0, tone(0, 100, 0.81))),
    ),
    "set_for_an_unknown_channel": (
        "limits",
        lambda: Talk().armed().staged(5, layer(0, tone(2, 100, 0.5))),
    ),
    "set_for_an_unknown_layer": (
        "limits",
        lambda: Talk().armed().staged(5, layer(4, tone(0, 100, 0.5))),
    ),
    "rise_too_steep": ("limits", lambda: Talk(slew=40).armed().playing()),  # 0.5 within 10 ms
    "message_of_an_unknown_type": ("garbage", lambda: Talk().armed().refused(27, (), 1)),
    "set_with_half_a_command": (
        "garbage",
        lambda: Talk().armed().refused(SET, part(5, layer(0, [0, 2000])), 2),
    ),
    "set_of_another_session": (
        "session",
        lambda: Talk().armed().refused(SET, part(5, layer(0), session=8), 10),
    ),
    "older_set_sent": (
        "token",
        lambda: Talk().armed().playing().refused(SET, part(4, layer(0)), 6),
    ),
    "knot_above_the_level": (
        "limits",
        lambda: (
            Talk().armed().staged(5, layer(0, [0 << 4 | 1 << 1, 2000, 5000, 0, 1, 100, 9000, 0]))
        ),
    ),
    "layers_above_the_level_together": (
        "limits",
        lambda: (
            Talk()
            .armed()
            .playing()
            .staged(6, layer(1, tone(0, 150, 0.5)))
            .committed(6, levels=(5000, 0), tokens=(5, 6, 0, 0))
        ),
    ),
    "wrong_checksum": (
        "garbage",
        lambda: Talk().armed().host_bytes(frame(GET_STATUS, sequence=77), flipped=-2),
    ),
    "set_before_arm": (
        "enabled",
        lambda: Talk().identified().rest(0.01).refused(SET, part(5, LOUD), 5),
    ),
    "vibration_without_a_finger": (
        "justified",
        lambda: Talk().armed().told("contacts", [1]).told("contacts", []).rest(0.1).playing(),
    ),
    "another_pattern": ("pattern", lambda: Talk(expected=[(100.0, 0.4, 0.0)]).armed().playing()),
    "plays_on_after_the_last_lift": (
        "lift",
        lambda: Talk().armed().told("contacts", [1]).playing().told("contacts", []).rest(0.05),
    ),
    "ramp_of_100_ms_after_the_last_lift": (
        "lift",
        lambda: (
            Talk()
            .armed()
            .told("contacts", [1])
            .playing()
            .told("contacts", [])
            .exchange(SILENCE, (9, 100), status(**HALF | {"tokens": (0,) * 4}))
        ),
    ),
    "touch_without_a_pattern": (
        "touch",
        lambda: Talk().armed().told("contacts", [1]).rest(0.11),
    ),
    "committed_on_one_of_two": (
        "commit",
        lambda: (
            Talk(names=("m", "n"))
            .armed()
            .armed(address=2)
            .staged(5, LOUD)
            .staged(5, LOUD, address=2)
            .committed(5, tokens=(5, 0, 0, 0))
            .rest(0.03)
        ),
    ),
    "same_token_with_other_contents": (
        "token",
        lambda: Talk().armed().staged(5, layer(0)).staged(5, layer(1)),
    ),
    "status_before_a_stop": (
        "stop",
        lambda: (
            Talk()
            .armed()
            .told("operator_command", "stop")
            .rest(0.007)
            .says(kind=GET_STATUS)
            .exchange(STOP, (5,), status(STOPPED, latch=1))
        ),
    ),
    "stop_not_sent": ("stop", lambda: Talk().armed().told("operator_command", "stop").rest(0.03)),
    "stop_neither_confirmed_nor_repeated": (
        "stop",
        lambda: (
            Talk()
            .armed()
            .playing()
            .exchange(STOP, (5,), status(STOPPED, latch=1, levels=(5000, 0), token=5))
            .rest(0.15)
        ),
    ),
    "heartbeat_after_a_stop": (
        "stop",
        lambda: (
            Talk()
            .armed()
            .exchange(STOP, (5,), status(STOPPED, latch=1))
            .rest(0.01)
            .says(STOPPED, latch=1)
        ),
    ),
    "no_heartbeat": (
        "heartbeat",
        lambda: Talk().armed().fed(1).rest(3.1).says(FAULT, fault=WATCHDOG, latch=1),
    ),
    "fed_while_the_loop_stalls": (
        "heartbeat",
        lambda: Talk().armed().told("set_stalled").rest(0.01).says(),
    ),
    "armed_without_a_request": (
        "armed",
        lambda: Talk().told("operator_command", "disarm").rest(0.5).armed(),
    ),
    "armed_without_identification": (
        "identified",
        lambda: Talk().told_of("opened").exchange(ARM, (9, 250, 0), status()),
    ),
    "request_before_a_reply": (
        "credit",
        lambda: (
            Talk(names=("m", "n"))
            .armed()
            .armed(address=2)
            .sends(GET_STATUS)
            .rest(0.005)
            .sends(GET_STATUS, address=2)
            .rest(0.001)
            .replies(GET_STATUS, status(left=241), address=2)
            .numbered(9)  # Hello, GetCaps, GetStatus and Arm of both came before
            .replies(GET_STATUS, status(left=235))
        ),
    ),
}
"""Conversations by what is wrong, each with the rule that it breaks."""
