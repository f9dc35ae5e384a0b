"""Rules for one set or envelope: each passes or raises CommandRefused.

    token -> times -> channels -> finite -> level -> frequency -> slots -> power

Every rule may rely on those before it. Rules that depend on the playback: `drivers.guard.record`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real

from drivers.command import CommandSet, DriveCommand, Envelope
from drivers.errors import CommandRefused
from drivers.guard.channel_state import steepest_rise
from drivers.guard.rounding import TOLERANCE
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Capabilities, Feature
from registry.limits import GuardLimits

_VALID_FOR = PROTOCOL.quantities.valid_for


@dataclass(frozen=True)
class GuardContext:
    """Context of a check: limits, amplifier, and the envelopes that a slot may hold."""

    limits: GuardLimits
    capabilities: Capabilities
    slots: Mapping[int, Sequence[Envelope]]


def check_set(command_set: CommandSet, context: GuardContext) -> None:
    """Raise CommandRefused for the first rule that the set violates."""
    for rule in _RULES:
        rule(command_set, context)


def check_envelope(envelope: Envelope, context: GuardContext) -> None:
    """Raise CommandRefused for an envelope that must not or cannot be played."""
    limits, capabilities = context.limits, context.capabilities
    if not _is_integer(envelope.slot, low=1, high=capabilities.envelope_slots):
        raise CommandRefused(
            f"envelope slot must be 1 to {capabilities.envelope_slots}, got {envelope.slot!r}"
        )
    low, high = capabilities.envelope_step_min, capabilities.envelope_step_max
    if not (is_finite(envelope.step) and low <= envelope.step <= high):
        raise CommandRefused(
            f"envelope step must be {low:g} to {high:g} s, got {envelope.step!r} s"
        )
    if len(envelope.knots) > capabilities.envelope_knots:
        raise CommandRefused(
            f"envelope must have at most {capabilities.envelope_knots} knots, got "
            f"{len(envelope.knots)} knots"
        )
    for number, knot in enumerate(envelope.knots):
        if not (
            is_finite(knot.level) and is_finite(knot.phase) and 0 <= knot.level <= limits.level
        ):
            raise CommandRefused(
                f"knot {number} must have a level of 0 to {limits.level:g} and a finite phase, got "
                f"{knot.level!r} and {knot.phase!r} degrees"
            )
    rise = steepest_rise([knot.phasor for knot in envelope.knots])
    if rise > limits.slew * envelope.step * TOLERANCE:
        raise CommandRefused(
            f"envelope in slot {envelope.slot}: level must rise by at most {limits.slew:g} per "
            f"second, got {rise:g} within {envelope.step:g} s; use a longer step"
        )


def is_finite(value: object) -> bool:
    """Whether a value is a finite real number."""
    # An exact float needs no look at its abstract classes.
    return (type(value) is float or isinstance(value, Real)) and math.isfinite(value)


def _are_finite(first: float, second: float, third: float) -> bool:
    """Whether three floats are finite, by their sum; false may mean that it is too large."""
    are_floats = type(first) is type(second) is type(third) is float
    return are_floats and math.isfinite(first + second + third)


def is_token(value: object) -> bool:
    """Whether a value can identify a set."""
    token = PROTOCOL.quantities.token
    return _is_integer(value, low=token.minimum, high=token.maximum)


def _is_integer(value: object, *, low: int, high: int) -> bool:
    return (type(value) is int or isinstance(value, Integral)) and low <= int(value) <= high


def _check_token(command_set: CommandSet, context: GuardContext) -> None:
    if not is_token(command_set.token):
        raise CommandRefused(f"token must be an integer of 1 to 65535, got {command_set.token!r}")


def _check_times(command_set: CommandSet, context: GuardContext) -> None:
    ends_itself = Feature.VALID_FOR in context.capabilities.features
    for name, value, highest in (
        ("ramp", command_set.ramp, context.capabilities.ramp_max),
        ("valid_for", command_set.valid_for, _VALID_FOR.high if ends_itself else 0.0),
    ):
        if not (is_finite(value) and 0 <= value <= highest):
            raise CommandRefused(f"{name} must be 0 to {highest:g} s, got {value!r} s")


def _check_channels(command_set: CommandSet, context: GuardContext) -> None:
    seen: set[int] = set()
    highest = context.capabilities.channels - 1
    for command in command_set.commands:
        channel = command.channel
        if not _is_integer(channel, low=0, high=highest):
            raise CommandRefused(
                f"channel must be 0 to {highest}, got {channel!r}", channel=channel
            )
        if channel in seen:
            raise CommandRefused(f"channel {channel} occurs twice in one set", channel=channel)
        seen.add(channel)


def _check_finite(command_set: CommandSet, context: GuardContext) -> None:
    for command in command_set.commands:
        if _are_finite(command.frequency, command.level, command.phase):
            continue
        for name, value in (
            ("frequency", command.frequency),
            ("level", command.level),
            ("phase", command.phase),
        ):
            if not is_finite(value):
                raise _refused(command, name, f"must be a finite number, got {value!r}")


def _check_levels(command_set: CommandSet, context: GuardContext) -> None:
    highest = context.limits.level
    for command in command_set.commands:
        if not 0 <= command.level <= highest:
            raise _refused(command, "level", f"must be 0 to {highest:g}, got {command.level:g}")


def _check_frequencies(command_set: CommandSet, context: GuardContext) -> None:
    low, high = context.limits.frequency_min, context.limits.frequency_max
    for command in command_set.commands:
        if (command.level > 0 or command.onset) and not low <= command.frequency <= high:
            raise _refused(
                command,
                "frequency",
                f"must be {low:g} to {high:g} Hz, got {command.frequency:g} Hz",
            )


def _check_slots(command_set: CommandSet, context: GuardContext) -> None:
    slots = context.capabilities.envelope_slots
    for command in command_set.commands:
        if type(command.onset) is type(command.ending) is int and not (
            command.onset or command.ending
        ):
            continue
        for name, slot in (("onset", command.onset), ("ending", command.ending)):
            if not _is_integer(slot, low=0, high=slots):
                raise _refused(
                    command, name, f"must be slot 0 (no envelope) to {slots}, got {slot!r}"
                )
            if slot and slot not in context.slots:
                raise _refused(
                    command, name, f"refers to empty slot {slot}; load an envelope into it first"
                )


def check_power(command_set: CommandSet, context: GuardContext) -> None:
    """Raise CommandRefused if the highest levels of all channels together exceed the power."""

    def peak_level(command: DriveCommand) -> float:
        if not (command.onset or command.ending):
            return command.level
        envelopes = [
            one for slot in (command.onset, command.ending) if slot for one in context.slots[slot]
        ]
        return max([command.level, *(knot.level for one in envelopes for knot in one.knots)])

    power = sum(peak_level(command) ** 2 for command in command_set.commands)
    if power > context.limits.power * TOLERANCE:
        raise CommandRefused(
            f"sum of squared levels must be at most {context.limits.power:g}, got {power:g}; lower "
            "the levels or drive fewer channels at once"
        )


def _refused(command: DriveCommand, name: str, problem: str) -> CommandRefused:
    return CommandRefused(f"{name} of channel {command.channel} {problem}", channel=command.channel)


_RULES: tuple[Callable[[CommandSet, GuardContext], None], ...] = (
    _check_token,
    _check_times,
    _check_channels,
    _check_finite,
    _check_levels,
    _check_frequencies,
    _check_slots,
    check_power,
)
