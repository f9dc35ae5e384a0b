"""Routing of excitations [m, rad] to layers of amplifiers by the wiring of the rig.

`sim/bench` translates back by the same wiring.
"""

import cmath
import math
from collections.abc import Mapping, Sequence

from controller.loop.envelopes import on_wire
from drivers.contents import Layer, Tone
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import QUANTITIES
from model.errors import InputError
from model.rig.rig import Rig
from model.transients.base_motion import Envelopes
from model.vibration import excitation as physics

Drive = Mapping[str, Tone]
"""What ERAs play, by name, without silent ones."""

_PER_HERTZ, _PER_FULL = QUANTITIES["frequency"].per_unit, QUANTITIES["level"].per_unit
_PER_DEGREE = QUANTITIES["phase"].per_unit


def route(
    excitation: physics.Excitation,
    rig: Rig,
    *,
    ramp: float,
    number: int = 0,
    playing: Drive | None = None,
    restarts: bool = False,
    valid_for: float = 0.0,
    onset: Envelopes | None = None,
    ending: Envelopes | None = None,
) -> dict[str, Layer]:
    """Return the layer of a number for every amplifier of the rig, by name.

    Every wired channel has a tone: level = amplitude / stroke, phase in degrees within half a turn,
    level 0 for an ERA that is not driven. ramp [s]: lengthened to the rig's slew limit, on all
    amplifiers alike. playing: what each ERA plays now in this layer (`tones_by_era`); a frequency
    keeps its phase if all its ERAs play it already, unless it restarts. valid_for [s]: of the
    layers. onset, ending: by ERA; an onset may lead an ERA that is not driven to silence. All other
    limits belong to the ledgers of the amplifiers. Raises InputError for an ERA that the rig does
    not have.
    """
    unknown = sorted(excitation.keys() - rig.wiring.keys())
    if unknown:
        raise InputError(
            f"pattern must drive ERAs of the rig, got {', '.join(unknown)}; build a table for this "
            "rig"
        )
    before: Drive = playing or {}
    restarted = restarted_by(excitation, {} if restarts else before)
    strokes = {era.name: era.stroke for era in rig.eras}
    onsets, endings = on_wire(strokes, onset, ending)
    wired: dict[str, list[Tone]] = {name: [] for name in rig.amplifiers}
    for name, channel in rig.wiring.items():
        driven, was, shape = excitation.get(name), before.get(name), onsets.get(name)
        if driven is None:
            # Falling silent while others play, it skips its ending, which belongs to all together.
            frequency = onset[name].frequency if onset and shape else rig.limits.frequency_min
            tone = Tone(channel.number, frequency, 0.0, 0.0, False, True, shape, endings.get(name))
        else:
            phase = driven.phase  # not finite it stays so, and the ledger refuses it
            if math.isfinite(phase):
                phase = math.degrees(math.remainder(phase, math.tau))
            tone = Tone(
                channel.number,
                driven.frequency,
                level=driven.amplitude / strokes[name],
                phase=phase,
                keep_phase=driven.frequency not in restarted,
                onset=shape,
                ending=endings.get(name),
            )
        wired[channel.amplifier].append(tone)
        rise = tone.level  # from rest, or through zero to another phase
        if was is not None and rise and was.frequency == tone.frequency:
            rise += was.level
        least = rise / rig.limits.slew
        ramp = least if least > ramp else ramp  # ledgers refuse NaN
    return {name: Layer(number, tuple(tones), ramp, valid_for) for name, tones in wired.items()}


def tones_by_era(
    played: Mapping[str, Sequence[LayerSet]], rig: Rig, number: int = 0
) -> dict[str, Tone]:
    """Return what each ERA plays in the layer of a number, by name; without silent ones."""
    playing = {
        (amplifier, command.channel): command
        for amplifier, layers in played.items()
        for one in layers
        for command in one.commands
        if one.layer == number and command.level > 0
    }
    return {
        name: Tone(
            channel.number,
            command.frequency / _PER_HERTZ,
            command.level / _PER_FULL,
            command.phase / _PER_DEGREE,
        )
        for name, channel in rig.wiring.items()
        if (command := playing.get((channel.amplifier, channel.number))) is not None
    }


def phasor_of(tone: Tone) -> complex:
    """Return the complex level of a tone."""
    return cmath.rect(tone.level, math.radians(tone.phase))


def restarted_by(excitation: physics.Excitation, playing: Drive) -> set[float]:
    """Return the frequencies [Hz] that restart at the commit, because an ERA joins them.

    All ERAs of one frequency must count its phase from one moment, or their field differs. Without
    any, all tones continue what ERAs play now.
    """
    restarted = set()
    for name, tone in excitation.items():
        if name not in playing or playing[name].frequency != tone.frequency:
            restarted.add(tone.frequency)
    return restarted
