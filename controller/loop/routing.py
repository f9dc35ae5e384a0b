"""From physics to electricity: which amplifier channel plays what, by the rig's wiring.

`sim/plant/plant.py` translates the other way by the same wiring.
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from controller.loop.envelopes import ending_slots, onset_slots
from drivers.command import CommandSet, DriveCommand
from drivers.protocol.messages import Achieved
from model.errors import InputError
from model.rig.rig import Rig
from model.transients.envelope import Envelopes
from model.vibration.excitation import Excitation


def route(
    excitation: Excitation,
    rig: Rig,
    *,
    token: int,
    ramp: float,
    playing: Mapping[str, DriveCommand] | None = None,
    onset: Envelopes | None = None,
) -> dict[str, CommandSet]:
    """One command set per amplifier of the rig, by its name, all under the same token.

    Every wired channel is named: level = amplitude / stroke, phase in degrees within (-180, 180];
    level 0 where the ERA is not driven. ramp [s] as in `CommandSet`; it becomes as
    long as the rig's limit of slew asks for, on all amplifiers alike. playing: what ERAs
    play now, as `drive_of_eras` tells it; a frequency that only ERAs play which play it already
    runs on undisturbed in time. onset: envelopes in the slots of `controller.loop.envelopes`;
    one may lead an ERA to silence that is not driven. Nothing else is limited here, that is the
    guard's; raises InputError if the excitation names an ERA the rig has not.
    """
    unknown = sorted(excitation.keys() - rig.wiring.keys())
    if unknown:
        raise InputError(
            f"the pattern drives {', '.join(unknown)}, which the rig does not have; "
            "build a table for this rig"
        )
    restarted = _restarted(excitation, playing or {})
    drive = {name: _drive(excitation, rig, name, restarted=restarted) for name in rig.wiring}
    if onset:
        slots = onset_slots(rig)
        for name, envelope in onset.items():
            drive[name] = replace(drive[name], frequency=envelope.frequency, onset=slots[name])
    highest = max((command.level for command in drive.values()), default=0.0)
    slowest = highest / rig.limits.slew  # from rest: what plays now only makes it shorter
    ramp = slowest if slowest > ramp else ramp  # not finite stays so, for the guard to refuse
    return _sets(drive, rig, token=token, ramp=ramp)


def drive_of_eras(played: Mapping[str, Achieved | CommandSet], rig: Rig) -> dict[str, DriveCommand]:
    """Which ERA plays what, by its name, from what amplifiers play; silent ones are left out."""
    playing = {
        (amplifier, command.channel): command
        for amplifier, several in played.items()
        for command in several.commands
        if command.level > 0
    }
    return {
        name: playing[channel.amplifier, channel.number]
        for name, channel in rig.wiring.items()
        if (channel.amplifier, channel.number) in playing
    }


def goes_on(excitation: Excitation, playing: Mapping[str, DriveCommand]) -> bool:
    """Whether any tone of an excitation runs on from what ERAs play now."""
    restarted = _restarted(excitation, playing)
    return any(tone.frequency not in restarted for tone in excitation.values())


def route_again(
    playing: Mapping[str, DriveCommand],
    rig: Rig,
    *,
    token: int,
    ramp: float,
    ending: Envelopes,
) -> dict[str, CommandSet]:
    """The sets, by amplifier, that go on with what ERAs play and give it endings."""
    drive = {name: _silent(channel.number, rig) for name, channel in rig.wiring.items()}
    slots = ending_slots(rig)
    for name, command in playing.items():
        slot = slots[name] if name in ending else 0
        drive[name] = replace(command, keep_phase=True, onset=0, ending=slot)
    return _sets(drive, rig, token=token, ramp=ramp)


def route_end(rig: Rig, *, token: int, ramp: float) -> dict[str, CommandSet]:
    """The sets, by amplifier, by which all ERAs fall silent, each along its ending if it has one.

    ramp [s]: for those without.
    """
    drive = {
        name: replace(_silent(channel.number, rig), skip_ending=False)
        for name, channel in rig.wiring.items()
    }
    return _sets(drive, rig, token=token, ramp=ramp)


def _sets(
    drive: Mapping[str, DriveCommand], rig: Rig, *, token: int, ramp: float
) -> dict[str, CommandSet]:
    """One command set per amplifier, by its name, of what every ERA is to play, by its own."""
    wired: dict[str, list[DriveCommand]] = {name: [] for name in rig.amplifiers}
    for name, channel in rig.wiring.items():
        wired[channel.amplifier].append(drive[name])
    return {
        name: CommandSet(
            token=token,
            commands=tuple(sorted(commands, key=lambda command: command.channel)),
            ramp=ramp,
            valid_for=0.0,
        )
        for name, commands in wired.items()
    }


def _restarted(excitation: Excitation, playing: Mapping[str, DriveCommand]) -> set[float]:
    """Frequencies [Hz] whose phases must count from the commit, for an ERA joins in with them.

    ERAs that play one frequency count its phase from one moment, else their field is another.
    """
    return {
        tone.frequency
        for name, tone in excitation.items()
        if name not in playing or playing[name].frequency != tone.frequency
    }


def _drive(excitation: Excitation, rig: Rig, name: str, *, restarted: set[float]) -> DriveCommand:
    """What one ERA's channel shall play."""
    number = rig.wiring[name].number
    tone = excitation.get(name)
    if tone is None:
        return _silent(number, rig)
    return DriveCommand(
        channel=number,
        frequency=tone.frequency,
        level=tone.amplitude / rig.era(name).stroke,
        phase=_wrapped_degrees(tone.phase),
        keep_phase=tone.frequency not in restarted,
    )


def _silent(number: int, rig: Rig) -> DriveCommand:
    """Nothing for a channel, from whatever it plays along the ramp.

    A silent channel has a frequency too, on every wire; this one is always allowed. A brake is one
    of all ERAs: what falls silent while others play fades.
    """
    return DriveCommand(
        channel=number, frequency=rig.limits.frequency_min, level=0.0, skip_ending=True
    )


def _wrapped_degrees(phase: float) -> float:
    """A phase [rad] in degrees within (-180, 180]."""
    # Not finite stays so, for the guard to refuse.
    degrees = math.degrees(math.remainder(phase, math.tau)) if math.isfinite(phase) else phase
    return 180.0 if degrees == -180.0 else degrees
