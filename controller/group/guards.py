"""A guard for every amplifier of a rig, by the limits of the rig file."""

from collections.abc import Mapping

from drivers.amplifier import Amplifier
from drivers.guard import Guard
from model.errors import InputError
from model.rig.rig import Rig


def make_guards(
    rig: Rig, amplifiers: Mapping[str, Amplifier], earlier: Mapping[str, Guard] | None = None
) -> dict[str, Guard]:
    """Make a guard for each open amplifier, by its name.

    earlier: those of an earlier opening; they are kept, with the vibrations that they count, where
    limits and capabilities are the same. Raises InputError for a wired channel that its amplifier
    does not have, CommandError for limits that leave nothing to play.
    """
    for era, wired in rig.wiring.items():
        channels = amplifiers[wired.amplifier].capabilities.channels
        if wired.number >= channels:
            raise InputError(
                f"channel of ERA {era} must be 0 to {channels - 1} on amplifier "
                f"{wired.amplifier}, got {wired.number}; change its wiring in the rig file"
            )
    guards = {}
    for name, amplifier in amplifiers.items():
        guard = (earlier or {}).get(name)
        if guard is None or not guard.is_for(rig.limits, amplifier.capabilities):
            guard = Guard(rig.limits, amplifier.capabilities)
        guards[name] = guard
    return guards
