"""A guard for every amplifier of a rig, by the limits of the rig file."""

from collections.abc import Mapping
from dataclasses import asdict

from drivers.amplifier import Amplifier
from drivers.guard import Guard, GuardLimits
from model.errors import InputError
from model.rig.rig import Limits, Rig


def make_guards(rig: Rig, amplifiers: Mapping[str, Amplifier]) -> dict[str, Guard]:
    """Make a guard for each open amplifier, by its name.

    Raises InputError for a wired channel that its amplifier does not have, CommandError for limits
    that leave nothing to play.
    """
    for era, wired in rig.wiring.items():
        channels = amplifiers[wired.amplifier].capabilities.channels
        if wired.number >= channels:
            raise InputError(
                f"channel of ERA {era} must be 0 to {channels - 1} on amplifier "
                f"{wired.amplifier}, got {wired.number}; change its wiring in the rig file"
            )
    limits = guard_limits(rig.limits)
    return {name: Guard(limits, amplifier.capabilities) for name, amplifier in amplifiers.items()}


def guard_limits(limits: Limits) -> GuardLimits:
    """Return the limits of a rig file as a guard takes them: the same names and units."""
    return GuardLimits(**asdict(limits))
