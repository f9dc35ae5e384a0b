"""Content common to all kinds of wire: quantities, commands, sets, envelopes and states.

Steps and bounds are copied from the table of docs/reference/wire-protocol.md.
"""

import struct
from collections.abc import Hashable, Mapping, Sequence
from typing import NamedTuple

from sim.witness.decoded import ChannelCommand, EnvelopeLoad, Request, RequestKind, Status


class OutOfRange(ValueError):
    """An integer out of range."""


INVALID = (OutOfRange, struct.error, IndexError)
"""Errors that show an invalid message."""


class Quantity(NamedTuple):
    """A quantity on a wire: its step, and bounds of the integer."""

    name: str
    step: float
    low: int
    high: int

    def whole(self, integer: int) -> int:
        """Check an integer; raises OutOfRange."""
        if not self.low <= integer <= self.high:
            raise OutOfRange(f"{self.name} must be {self.low} to {self.high}, got {integer}")
        return integer

    def value(self, integer: int) -> float:
        """Scale an integer to its unit; raises OutOfRange."""
        return self.whole(integer) * self.step


FREQUENCY = Quantity("frequency", 0.05, 0, 65535)  # Hz
LEVEL = Quantity("level", 0.0001, 0, 10000)
PHASE = Quantity("phase", 0.01, -18000, 17999)  # degrees
RAMP = Quantity("ramp", 0.001, 0, 1000)  # s
VALID_FOR = Quantity("valid_for", 0.001, 0, 60000)  # s
WATCHDOG = Quantity("watchdog", 0.001, 100, 2000)  # s
WATCHDOG_LEFT = Quantity("watchdog_left", 0.001, 0, 2000)  # s
TOKEN = Quantity("token", 1, 1, 65535)


def is_newer(token: int, than: int) -> bool:
    """Whether a token is newer than another, 0 being none."""
    return than == 0 or 1 <= (token - than) % 65536 <= 32767


ACTIVE_TOKEN = Quantity("token", 1, 0, 65535)
CHANNEL = Quantity("channel", 1, 0, 15)
CHANNEL_COUNT = Quantity("channel_count", 1, 0, 16)
KNOTS = Quantity("envelope_knots", 1, 0, 32)
SLOT = Quantity("envelope_slot", 1, 0, 63)
STEP = Quantity("envelope_step", 0.0001, 0, 1000)  # s
TEMPERATURE = Quantity("temperature", 0.1, -1000, 2000)  # °C
STATE = Quantity("state", 1, 0, 7)
FAULT = Quantity("fault", 1, 0, 255)


def request_of(
    kind: RequestKind,
    address: int,
    key: Hashable,
    *,
    token: int | None = None,
    ramp: int = 0,
    valid_for: int = 0,
    watchdog: int | None = None,
    session: int | None = None,
    commands: Mapping[int, ChannelCommand] | None = None,
    problem: str = "",
) -> Request:
    """A request from the integers of a frame; raises OutOfRange.

    The ramp of what silences is clipped into range.
    """
    if kind in (RequestKind.STOP, RequestKind.DISARM):
        ramp = min(ramp, RAMP.high)
    return Request(
        kind,
        address,
        key,
        token=0 if token is None else TOKEN.whole(token),
        ramp=RAMP.value(ramp),
        valid_for=VALID_FOR.value(valid_for),
        watchdog=0.0 if watchdog is None else WATCHDOG.value(watchdog),
        session=session,
        commands=commands or {},
        problem=problem,
    )


def command_of(
    frequency: int, level: int, phase: int, flags: int, *, onset: int = 0, ending: int = 0
) -> ChannelCommand:
    """The command of one channel; flags: bits 0 and 1. Raises OutOfRange."""
    return ChannelCommand(
        FREQUENCY.value(frequency),
        LEVEL.value(level),
        PHASE.value(phase),
        keep_phase=bool(flags & 1),
        skip_ending=bool(flags & 2),
        onset=SLOT.whole(onset),
        ending=SLOT.whole(ending),
    )


def envelope_of(
    slot: int, step: int, count: int, levels: Sequence[int], phases: Sequence[int]
) -> EnvelopeLoad:
    """An envelope with `count` knots; raises OutOfRange."""
    if not count == len(levels) == len(phases):
        raise OutOfRange("envelope length does not match its knots")
    KNOTS.whole(count)
    for phase in phases:
        PHASE.whole(phase)
    return EnvelopeLoad(SLOT.whole(slot), STEP.value(step), tuple(map(LEVEL.value, levels)))


def status_of(
    state: int,
    fault: int,
    token: int,
    *,
    left: int,
    high_voltage: bool | None,
    temperature: int | None,
    levels: Sequence[int] | None,
) -> Status:
    """A status from the integers of a frame, None where it does not carry them."""
    return Status(
        STATE.whole(state),
        FAULT.whole(fault),
        token,
        WATCHDOG_LEFT.value(left),
        high_voltage,
        None if temperature is None else TEMPERATURE.value(temperature),
        None if levels is None else tuple(map(LEVEL.value, levels)),
    )


def signed(word: int) -> int:
    """A word of 16 bits in two's complement."""
    return word - 0x10000 if word & 0x8000 else word
