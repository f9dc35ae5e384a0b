"""A guard for every amplifier of a rig, by the limits that its file sets."""

from collections.abc import Mapping
from dataclasses import asdict

from drivers.amplifier import Amplifier
from drivers.guard import Guard, GuardLimits
from model.errors import InputError
from model.rig.rig import Limits, Rig


def make_guards(rig: Rig, amplifiers: Mapping[str, Amplifier]) -> dict[str, Guard]:
    """A guard per open amplifier, by its name.

    Raises InputError for a channel that an amplifier has not, CommandError for limits that leave
    nothing to play.
    """
    for era, wired in rig.wiring.items():
        channels = amplifiers[wired.amplifier].capabilities.channels
        if wired.number >= channels:
            raise InputError(
                f"ERA {era} is wired to channel {wired.number} of amplifier "
                f"{wired.amplifier}, which has channels 0 to {channels - 1}; change the rig"
            )
    limits = guard_limits(rig.limits)
    return {name: Guard(limits, amplifier.capabilities) for name, amplifier in amplifiers.items()}


def guard_limits(limits: Limits) -> GuardLimits:
    """The rig's limits as a guard takes them."""
    return GuardLimits(**asdict(limits))
