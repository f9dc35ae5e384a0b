"""Voltage limits: checked after a set of motion has passed its guard and was converted."""

import math
from collections.abc import Sequence
from dataclasses import replace

from drivers.command import DriveCommand
from drivers.errors import CommandRefused
from drivers.guard.guard import _KEY, SafeCommandSet
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import ChannelLimits

_ROUNDING = 1 + 1e-9
_Q = PROTOCOL.quantities


def safe_voltages(
    safe: SafeCommandSet, commands: Sequence[DriveCommand], limits: Sequence[ChannelLimits]
) -> SafeCommandSet:
    """Return a set that passed its guard with commands of voltage, as the wire rounds them.

    limits: by channel, of the amplitude of the voltage as a share of the full one, and of its
    frequency [Hz]. Raises CommandRefused for a command beyond them.
    """
    wanted = {command.channel for command in safe.commands}
    if [command.channel for command in commands] != [one.channel for one in safe.commands]:
        raise CommandRefused(f"commands of voltage must be of channels {sorted(wanted)}")
    return SafeCommandSet(
        safe.token,
        tuple(_checked(command, limits[command.channel]) for command in commands),
        ramp=safe.ramp,
        valid_for=safe.valid_for,
        settled_after=safe.settled_after,
        record=safe.record,
        key=_KEY,
    )


def _checked(command: DriveCommand, limits: ChannelLimits) -> DriveCommand:
    """Return a command within its limits, rounded; raises CommandRefused."""
    channel = command.channel
    if not (math.isfinite(command.level) and 0 <= command.level <= limits.level_max * _ROUNDING):
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
