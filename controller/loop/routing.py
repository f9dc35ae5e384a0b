"""Routing of excitations [m, rad] to layers of amplifiers by the wiring of the rig.

`sim/bench` translates back by the same wiring.
"""

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from controller.loop.envelopes import shapes_of
from drivers.contents import Layer, Tone
from drivers.protocol.sets import LayerSet
from drivers.protocol.table import QUANTITIES
from model.errors import InputError
from model.rig.rig import Channel, Rig
from model.transients.base_motion import Envelopes
from model.vibration import excitation as physics

Drive = Mapping[str, Tone]
"""What ERAs play, by name, without silent ones."""

_FREQUENCY, _LEVEL, _PHASE = (QUANTITIES[name] for name in ("frequency", "level", "phase"))


def route(
    excitation: physics.Excitation,
    rig: Rig,
    *,
    ramp: float,
    number: int = 0,
    playing: Drive | None = None,
    restarts: bool = False,
    valid_for: float = 0.0,
) -> dict[str, Layer]:
    """Return the layer of a number for every amplifier of the rig, by name.

    Every wired channel has a tone: level = amplitude / stroke, phase in degrees within (-180, 180],
    level 0 for an ERA that is not driven. ramp [s]: lengthened to the rig's slew limit, on all
    amplifiers alike. playing: what each ERA plays now in this layer (`tones_by_era`); a frequency
    keeps its phase if all its ERAs play it already, unless it restarts. valid_for [s]: of the
    layers. All other limits belong to the ledgers of the amplifiers. Raises InputError for an ERA
    that the rig does not have.
    """
    unknown = sorted(excitation.keys() - rig.wiring.keys())
    if unknown:
        raise InputError(
            f"pattern must drive ERAs of the rig, got {', '.join(unknown)}; build a table for this "
            "rig"
        )
    before: Drive = playing or {}
    restarted = _restarted(excitation, {} if restarts else before)
    strokes = {era.name: era.stroke for era in rig.eras}
    wired: dict[str, list[Tone]] = {name: [] for name in rig.amplifiers}
    for name, channel in rig.wiring.items():
        tone = _tone(excitation.get(name), rig, channel.number, strokes[name], restarted=restarted)
        wired[channel.amplifier].append(tone)
        min_ramp = _rise(tone, before.get(name)) / rig.limits.slew
        ramp = min_ramp if min_ramp > ramp else ramp  # ledgers refuse NaN
    return {
        name: Layer(number, tuple(tones), ramp=ramp, valid_for=valid_for)
        for name, tones in wired.items()
    }


def _rise(tone: Tone, before: Tone | None) -> float:
    """Return the highest rise of a level: from rest, or through zero to another phase."""
    if before is None or not tone.level or before.frequency != tone.frequency:
        return tone.level
    return tone.level + before.level


def shaped(
    layers: Mapping[str, Layer], rig: Rig, *, onset: Envelopes | None, ending: Envelopes | None
) -> dict[str, Layer]:
    """Return layers with shaped onsets and endings, which are by ERA.

    An onset may lead an ERA that is not driven to silence.
    """
    onsets, endings = shapes_of(onset, rig), shapes_of(ending, rig)
    eras = {channel: era for era, channel in rig.wiring.items()}
    found = {}
    for name, layer in layers.items():
        tones = []
        for tone in layer.tones:
            era = eras[Channel(name, tone.channel)]
            if onset and era in onset:
                tone = replace(tone, frequency=onset[era].frequency)
            tones.append(replace(tone, onset=onsets.get(era), ending=endings.get(era)))
        found[name] = replace(layer, tones=tuple(tones))
    return found


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
            _FREQUENCY.from_wire(command.frequency),
            _LEVEL.from_wire(command.level),
            _PHASE.from_wire(command.phase),
        )
        for name, channel in rig.wiring.items()
        if (command := playing.get((channel.amplifier, channel.number))) is not None
    }


def phasor_of(tone: Tone) -> complex:
    """Return the complex level of a tone."""
    return cmath.rect(tone.level, math.radians(tone.phase))


def continues_all_tones(excitation: physics.Excitation, playing: Drive) -> bool:
    """Whether all tones of an excitation continue what ERAs play now."""
    return not _restarted(excitation, playing)


def _restarted(excitation: physics.Excitation, playing: Drive) -> set[float]:
    """Return the frequencies [Hz] that restart at the commit, because an ERA joins them.

    All ERAs of one frequency must count its phase from one moment, or their field differs.
    """
    return {
        tone.frequency
        for name, tone in excitation.items()
        if name not in playing or playing[name].frequency != tone.frequency
    }


def _tone(
    tone: physics.Tone | None, rig: Rig, number: int, stroke: float, *, restarted: set[float]
) -> Tone:
    """Return what a channel plays for the tone of its ERA, of a stroke [m].

    A channel that falls silent while others play skips its ending, which belongs to all ERAs
    together.
    """
    if tone is None:
        return Tone(number, rig.limits.frequency_min, 0.0, skip_ending=True)
    return Tone(
        channel=number,
        frequency=tone.frequency,
        level=tone.amplitude / stroke,
        phase=_wrapped_degrees(tone.phase),
        keep_phase=tone.frequency not in restarted,
    )


def _wrapped_degrees(phase: float) -> float:
    """Convert a phase [rad] to degrees within (-180, 180]."""
    # Not finite stays so; the ledger refuses it.
    degrees = math.degrees(math.remainder(phase, math.tau)) if math.isfinite(phase) else phase
    return 180.0 if degrees == -180.0 else degrees
