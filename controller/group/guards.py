"""A guard for every amplifier of a rig, by the limits of the rig file; which ones are driven."""

from collections.abc import Mapping

from drivers.amplifier import Amplifier
from drivers.errors import CommandError
from drivers.guard import Guard
from drivers.protocol.messages import Feature
from model.errors import InputError
from model.rig.rig import Rig


def check_watchdogs(amplifiers: Mapping[str, Amplifier]) -> None:
    """Raise CommandError for an open amplifier without a watchdog, by its name."""
    for name, amplifier in amplifiers.items():
        if Feature.WATCHDOG not in amplifier.capabilities.features:
            raise CommandError(
                f"amplifier {name} must have a watchdog, got one of class C, which plays on when "
                "this program ends; use another, or set supervised: true in the daemon's file if "
                "somebody can always switch it off"
            )


def is_known_unwatched(amplifier: Amplifier) -> bool:
    """Whether an amplifier was identified and has no watchdog."""
    try:
        return Feature.WATCHDOG not in amplifier.capabilities.features
    except CommandError:
        return False


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
