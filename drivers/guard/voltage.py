"""Voltage limits: checked after a set of motion has passed its guard and was converted."""

import math
from dataclasses import replace

from drivers.command import DriveCommand, Knot
from drivers.errors import CommandRefused
from drivers.guard.rounding import TOLERANCE
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import ChannelLimits

_Q = PROTOCOL.quantities


def checked_voltage(
    command: DriveCommand, passed: DriveCommand, limits: ChannelLimits
) -> DriveCommand:
    """Return a command of voltage as the wire rounds it; raises CommandRefused beyond its limits.

    passed: the command of motion; the voltage of a silent one is 0, and envelopes and flags are the
    same. limits: of its amplitude as a share of the full voltage, and of its frequency [Hz].
    """
    channel = command.channel
    if command.level > 0 and not passed.level > 0:
        raise CommandRefused(
            f"voltage of channel {channel} must be 0 where its motion is, got {command.level:g}",
            channel=channel,
        )
    as_passed = replace(
        passed, frequency=command.frequency, level=command.level, phase=command.phase
    )
    if command != as_passed:
        raise CommandRefused(
            f"envelopes and flags of the voltage of channel {channel} must be those of its motion, "
            f"got {command} for {passed}",
            channel=channel,
        )
    if not _is_within(command.level, limits):
        raise CommandRefused(
            f"voltage of channel {channel} must be 0 to {limits.level_max:g} of the full one, got "
            f"{command.level:g}; lower the level, or its limit in the rig file",
            channel=channel,
        )
    low, high = limits.frequency_min, limits.frequency_max
    if command.level > 0 and not low <= command.frequency <= high:
        raise CommandRefused(
            f"voltage of channel {channel} must have a frequency of {low:g} to {high:g} Hz, got "
            f"{command.frequency:g} Hz; narrow limits.frequency in the rig file",
            channel=channel,
        )
    return replace(
        command,
        frequency=_Q.frequency.quantise(command.frequency),
        level=_Q.level.quantise(min(command.level, limits.level_max)),
        phase=_Q.phase.quantise(command.phase),
    )


def checked_knot(knot: Knot, passed: Knot, limits: ChannelLimits, *, slot: int) -> Knot:
    """Return a knot of voltage as the wire rounds it; raises CommandRefused beyond its limits.

    passed: the knot of motion; the voltage of a silent one is 0.
    """
    if knot.level > 0 and not passed.level > 0:
        raise CommandRefused(
            f"voltage of the envelope in slot {slot} must be 0 where its motion is, got "
            f"{knot.level:g}"
        )
    if not _is_within(knot.level, limits):
        raise CommandRefused(
            f"voltage of the envelope in slot {slot} must be 0 to {limits.level_max:g} of the full "
            f"one, got {knot.level:g}; lower the level, or its limit in the rig file"
        )
    level = min(knot.level, limits.level_max)
    return Knot(_Q.level.quantise(level), _Q.phase.quantise(knot.phase))


def _is_within(level: float, limits: ChannelLimits) -> bool:
    return math.isfinite(level) and 0 <= level <= limits.level_max * TOLERANCE
