"""The amplifiers of a rig from a script: opened by the rig's URLs and limits, told patterns."""

from controller.group.guards import guard_limits
from controller.loop.routing import route
from drivers.blocking import BlockingAmplifier
from drivers.command import DriveCommand
from era_haptics.arguments import expect_rig
from era_haptics.drive import Drives, excitation_of
from model.errors import InputError
from model.rig.rig import Rig
from model.table.pattern import Pattern


def open_amplifier(
    rig: Rig, name: str | None = None, *, url: str | None = None
) -> BlockingAmplifier:
    """An amplifier of the rig, open as long as a `with` block lasts, and disarmed after it.

    name: may be left out where the rig has one only; url: in place of the rig's own. Nothing beyond
    the rig's limits is sent. Raises InputError for one that the rig has not; in the block
    CommandError for a URL that is none, LinkError where nobody answers, CommandRefused.
    """
    expect_rig(rig)
    known = tuple(rig.amplifiers)
    chosen = known if name is None else tuple(each for each in known if each == name)
    if len(chosen) != 1:
        raise InputError(f"the rig has the amplifiers {', '.join(known)}; name one of them")
    return BlockingAmplifier(url or rig.amplifiers[chosen[0]], limits=guard_limits(rig.limits))


def commands_for(rig: Rig, drive: Pattern | Drives) -> dict[str, tuple[DriveCommand, ...]]:
    """What the channels play, by the amplifier's name, for its `play` and `apply`.

    Channels by the rig's wiring, levels 0..1 of full stroke, phases in degrees. A pattern's
    envelopes are not in it. Raises InputError for an ERA that the rig has not.
    """
    expect_rig(rig)
    sets = route(excitation_of(drive, rig), rig, token=1, ramp=0.0)
    return {name: asked.commands for name, asked in sets.items()}
