"""Routing of excitations [m, rad] to command sets by the wiring of the rig.

`sim/bench/bench.py` translates back by the same wiring.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from operator import attrgetter

from controller.loop.envelopes import ending_slots, onset_slots
from drivers.command import CommandSet, DriveCommand
from drivers.protocol.messages import Achieved
from model.errors import InputError
from model.rig.rig import Rig
from model.transients.envelope import Envelopes
from model.vibration.excitation import Excitation, Tone

_CHANNEL = attrgetter("channel")


def route(
    excitation: Excitation,
    rig: Rig,
    *,
    token: int,
    ramp: float,
    playing: Mapping[str, DriveCommand] | None = None,
    onset: Envelopes | None = None,
    valid_for: float = 0.0,
) -> dict[str, CommandSet]:
    """Return a command set for every amplifier of the rig, by name, all under one token.

    Every wired channel has a command: level = amplitude / stroke, phase in degrees within
    (-180, 180], level 0 for an ERA that is not driven. ramp [s]: lengthened to the rig's slew
    limit, on all amplifiers alike. playing: what each ERA plays now (`commands_by_era`); a
    frequency keeps its phase if all its ERAs play it already. onset: envelopes in the slots of
    `controller.loop.envelopes`; one may lead an ERA that is not driven to silence. valid_for [s]:
    of the sets. All other limits belong to the guard. Raises InputError for an ERA that the rig
    does not have.
    """
    unknown = sorted(excitation.keys() - rig.wiring.keys())
    if unknown:
        raise InputError(
            f"pattern must drive ERAs of the rig, got {', '.join(unknown)}; build a table for this "
            "rig"
        )
    restarted = _restarted(excitation, playing or {})
    strokes = {era.name: era.stroke for era in rig.eras}
    drive = {
        name: _drive(excitation.get(name), rig, channel.number, strokes[name], restarted=restarted)
        for name, channel in rig.wiring.items()
    }
    if onset:
        slots = onset_slots(rig)
        for name, envelope in onset.items():
            drive[name] = replace(drive[name], frequency=envelope.frequency, onset=slots[name])
    max_rise = max((_rise(drive[name], (playing or {}).get(name)) for name in drive), default=0.0)
    min_ramp = max_rise / rig.limits.slew
    ramp = min_ramp if min_ramp > ramp else ramp  # the guard refuses NaN
    return _sets(drive, rig, token=token, ramp=ramp, valid_for=valid_for)


def _rise(command: DriveCommand, before: DriveCommand | None) -> float:
    """Return the highest rise of a level: from rest, or through zero to another phase."""
    if before is None or not command.level or before.frequency != command.frequency:
        return command.level
    return command.level + before.level


def commands_by_era(
    played: Mapping[str, Achieved | CommandSet], rig: Rig
) -> dict[str, DriveCommand]:
    """Return what each ERA plays, by name, from what amplifiers play; without silent ones."""
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


def continues_any_tone(excitation: Excitation, playing: Mapping[str, DriveCommand]) -> bool:
    """Whether any tone of an excitation continues what ERAs play now."""
    restarted = _restarted(excitation, playing)
    return any(tone.frequency not in restarted for tone in excitation.values())


def route_with_endings(
    playing: Mapping[str, DriveCommand],
    rig: Rig,
    *,
    token: int,
    ramp: float,
    ending: Envelopes,
) -> dict[str, CommandSet]:
    """Return the sets, by amplifier, that continue what ERAs play and add endings."""
    drive = {name: _silent(channel.number, rig) for name, channel in rig.wiring.items()}
    slots = ending_slots(rig)
    for name, command in playing.items():
        slot = slots[name] if name in ending else 0
        drive[name] = replace(command, keep_phase=True, onset=0, ending=slot)
    return _sets(drive, rig, token=token, ramp=ramp)


def route_to_silence(rig: Rig, *, token: int, ramp: float) -> dict[str, CommandSet]:
    """Return the sets, by amplifier, that silence all ERAs along their endings.

    ramp [s]: for those without an ending.
    """
    drive = {
        name: replace(_silent(channel.number, rig), skip_ending=False)
        for name, channel in rig.wiring.items()
    }
    return _sets(drive, rig, token=token, ramp=ramp)


def _sets(
    drive: Mapping[str, DriveCommand],
    rig: Rig,
    *,
    token: int,
    ramp: float,
    valid_for: float = 0.0,
) -> dict[str, CommandSet]:
    """Return the command set of every amplifier, by name, from the command of every ERA."""
    wired: dict[str, list[DriveCommand]] = {name: [] for name in rig.amplifiers}
    for name, channel in rig.wiring.items():
        wired[channel.amplifier].append(drive[name])
    return {
        name: CommandSet(
            token=token,
            commands=tuple(sorted(commands, key=_CHANNEL)),
            ramp=ramp,
            valid_for=valid_for,
        )
        for name, commands in wired.items()
    }


def _restarted(excitation: Excitation, playing: Mapping[str, DriveCommand]) -> set[float]:
    """Return the frequencies [Hz] that restart at the commit, because an ERA joins them.

    All ERAs of one frequency must count its phase from one moment, or their field differs.
    """
    return {
        tone.frequency
        for name, tone in excitation.items()
        if name not in playing or playing[name].frequency != tone.frequency
    }


def _drive(
    tone: Tone | None, rig: Rig, number: int, stroke: float, *, restarted: set[float]
) -> DriveCommand:
    """Return the command of a channel for the tone of its ERA, of a stroke [m]."""
    if tone is None:
        return _silent(number, rig)
    return DriveCommand(
        channel=number,
        frequency=tone.frequency,
        level=tone.amplitude / stroke,
        phase=_wrapped_degrees(tone.phase),
        keep_phase=tone.frequency not in restarted,
    )


def _silent(number: int, rig: Rig) -> DriveCommand:
    """Return the command that silences a channel along the ramp.

    Silent channels also have a frequency on every wire; this one is always allowed. Endings belong
    to all ERAs together, so a channel that falls silent while others play skips its own.
    """
    return DriveCommand(
        channel=number, frequency=rig.limits.frequency_min, level=0.0, skip_ending=True
    )


def _wrapped_degrees(phase: float) -> float:
    """Convert a phase [rad] to degrees within (-180, 180]."""
    # Not finite stays so; the guard refuses it.
    degrees = math.degrees(math.remainder(phase, math.tau)) if math.isfinite(phase) else phase
    return 180.0 if degrees == -180.0 else degrees
