"""Routing: layers for the channels of each amplifier, from excitations of ERAs and envelopes.

Excitations [m, rad] become tones of channels by the wiring of the rig, and envelopes integers of
the wire; `sim/bench` translates back by the same wiring. A set includes its onset, so a touch waits
for that; its ending follows in a separate set, which takes no longer. An onset of fewer knots
follows the same curve in longer steps, which keeps quiet fingers quieter than a ramp does down to a
single knot; an ending is sent whole or not at all. The last value of an envelope, the pattern
itself or silence, is in the command and not among the knots on the wire.

An envelope of a continuous effect is played in pieces. An amplifier plays a piece along straight
lines between its knots, and holds a second piece that waits for the end of the first. So pieces
follow each other without a gap if the host is late by at most half a piece. The first piece is
short, because a touch waits for it.
"""

import math
from collections.abc import Mapping, Sequence, Set
from itertools import islice

import numpy as np

from controller.play.intent import Pulse
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.protocol.definition import QUANTITIES
from drivers.protocol.sets import Command, Envelope, LayerSet
from model import vibration as physics
from model.answer.envelope import COURSE_KNOT_STEP, Course
from model.errors import InputError
from model.rig.rig import Rig
from model.transients.base_motion import BaseEnvelope, Envelopes

BESIDE_CLICK = 0.100
"""Fade-out [s] next to a short pulse; a shorter one would be felt with the pulse."""

PLAIN_STEP = 0.050
"""Time [s] of each ramp, and set, that replaces knots on amplifiers without them."""

HELD = 0.1
"""Time [s] after its last piece at which a layer ends on its own."""

_FIRST_PIECE = 0.16  # s
_NEXT_PIECE = 0.32  # s
_SHORTEST_PIECE = 0.12  # s; used with few knots
_JOINING_STEP = 0.020  # s; between knots of a first piece that starts within its course

MAX_STEP = _SHORTEST_PIECE / 2
"""Time [s] between the knots of an envelope with one knot."""

_FREQUENCY = QUANTITIES["frequency"]
_LEVEL = QUANTITIES["level"]
_PHASE = QUANTITIES["phase"]
_STEP = QUANTITIES["envelope_step"]
_DIGITS = 6  # decimals of a step on the wire
_ROUNDING = 1e-9  # s

Drive = Mapping[str, AmplifierTone]
"""Tones by ERA, without silent ones."""

PlateLayer = Mapping[str, AmplifierLayer]
"""A layer on all amplifiers, by amplifier name."""


def piece_of(
    course: Course, pulse: Pulse, since: float, *, knots: int, is_first: bool
) -> tuple[float, list[float]]:
    """Return the piece of a course that is played from a time [s] after the start of its pulse on.

    A piece is a step [s] and values, the first a step after its start; a single value is a ramp.
    The envelope repeats until the pulse ends, at 0. knots: maximum of an envelope, 0 for ramps;
    is_first: whether the piece is the first of its layer.
    """
    step = PLAIN_STEP
    count = 1
    if knots:
        joins = is_first and since > 0
        shortest_step = _JOINING_STEP if joins else COURSE_KNOT_STEP
        length = _FIRST_PIECE if is_first else _NEXT_PIECE
        max_count = min(knots + 1, round(length / shortest_step))
        step = max(shortest_step, _SHORTEST_PIECE / max_count)
        steps_left = min((pulse.duration - since) / step, max_count)
        count = max(math.ceil(steps_left - _ROUNDING), 2)
    times = since + step * np.arange(1, count + 1)
    shares = np.asarray(course.at(np.mod(times, course.duration)))
    shares[times > pulse.duration - _ROUNDING] = 0.0
    return step, shares.tolist()


def route(
    excitation: physics.Excitation,
    rig: Rig,
    *,
    ramp: float,
    number: int = 0,
    playing: Drive | None = None,
    restarted: Set[float] | None = None,
    valid_for: float = 0.0,
    onset: Envelopes | None = None,
    ending: Envelopes | None = None,
) -> dict[str, AmplifierLayer]:
    """Return the layer of a number for every amplifier of the rig, by name.

    Every wired channel has a tone: level = amplitude / stroke, phase in degrees within half a turn,
    level 0 for an ERA that is not driven. ramp [s]: lengthened to the rig's slew limit, on all
    amplifiers alike. playing: tones in this layer now, by ERA (`tones_by_era`). restarted:
    frequencies that do not keep their phase; by default, frequencies not yet played by all their
    ERAs. valid_for [s]: of the layers. onset, ending: by ERA; an onset can lead an undriven ERA to
    silence. The ledgers of the amplifiers check all other limits. Raises InputError for an unknown
    ERA.
    """
    drive: Drive = playing or {}
    if restarted is None:
        restarted = restarted_by(excitation, drive)
    tones = _tones(excitation, rig, restarted, onset=onset, ending=ending)
    wired: dict[str, list[AmplifierTone]] = {name: [] for name in rig.amplifiers}
    largest_rise = 0.0
    for name, tone in tones.items():
        channel = rig.wiring[name]
        wired[channel.amplifier].append(tone)
        # A rise of NaN, which the ledgers reject, changes nothing here.
        largest_rise = max(largest_rise, _rise(tone, drive.get(name)))
    ramp = max(ramp, largest_rise / rig.limits.slew)
    layers = dict[str, AmplifierLayer]()
    for amplifier, amplifier_tones in wired.items():
        layers[amplifier] = AmplifierLayer(number, tuple(amplifier_tones), ramp, valid_for)
    return layers


def _tones(
    excitation: physics.Excitation,
    rig: Rig,
    restarted: Set[float],
    *,
    onset: Envelopes | None = None,
    ending: Envelopes | None = None,
) -> dict[str, AmplifierTone]:
    """Return the tone of every wired ERA, by name; see `route`."""
    unknown = sorted(excitation.keys() - rig.wiring.keys())
    if unknown:
        raise InputError(
            f"pattern must drive ERAs of the rig, got {', '.join(unknown)}; build a table for this "
            "rig"
        )
    strokes = rig.full_levels
    onsets, endings = on_wire(strokes, onset, ending)
    tones = dict[str, AmplifierTone]()
    for name, channel in rig.wiring.items():
        driven = excitation.get(name)
        if driven is None:
            frequency = rig.limits.frequency_min
            if onset and name in onsets:
                frequency = onset[name].frequency
            tones[name] = AmplifierTone(
                channel=channel.number,
                frequency=frequency,
                level=0.0,
                # If other ERAs play on, it falls silent without the layer's ending.
                skip_ending=True,
                onset=onsets.get(name),
                ending=endings.get(name),
            )
        else:
            tones[name] = AmplifierTone(
                channel=channel.number,
                frequency=driven.frequency,
                level=driven.amplitude / strokes[name],
                phase=_degrees(driven.phase),
                keep_phase=driven.frequency not in restarted,
                onset=onsets.get(name),
                ending=endings.get(name),
            )
    return tones


def _degrees(phase: float) -> float:
    """Return a phase [rad] in degrees within half a turn; the ledger rejects infinity and NaN."""
    return math.degrees(math.remainder(phase, math.tau)) if math.isfinite(phase) else phase


def _rise(tone: AmplifierTone, former_tone: AmplifierTone | None) -> float:
    """Return the largest change of level when a tone starts: from rest, or through a phase turn."""
    if former_tone is None or not tone.level or former_tone.frequency != tone.frequency:
        return tone.level
    return tone.level + former_tone.level


def restarted_by(excitation: physics.Excitation, playing: Drive) -> set[float]:
    """Return the frequencies [Hz] that restart at the commit because an ERA joins them.

    All ERAs with the same frequency must count its phase from the same moment, or their field
    changes.
    """
    return {
        tone.frequency
        for name, tone in excitation.items()
        if name not in playing or playing[name].frequency != tone.frequency
    }


def thinned(envelopes: Envelopes, *, knots: int) -> Envelopes:
    """Return envelopes, by ERA, with a limited number of knots before the last value.

    They take the same time, in whole steps of the wire, with equal step and number of knots.
    """
    first = next(iter(envelopes.values()))
    count = len(first.knots)
    new_count = knots + 1
    if count <= new_count:
        return envelopes
    duration = round(first.duration * _STEP.per_unit)  # in steps of the wire
    step = math.ceil(duration / new_count) / _STEP.per_unit
    times = np.minimum(step * np.arange(1, new_count + 1), first.duration)
    positions = times / first.step
    lower = np.minimum(positions.astype(int), count - 1)
    values = np.array([(envelope.start, *envelope.knots) for envelope in envelopes.values()])
    slopes = values[:, lower + 1] - values[:, lower]
    rows = values[:, lower] + slopes * (positions - lower)
    thin = dict[str, BaseEnvelope]()
    for (name, envelope), row in zip(envelopes.items(), rows.tolist(), strict=True):
        thin[name] = BaseEnvelope(envelope.frequency, envelope.start, tuple(row), step)
    return thin


def on_wire(strokes: Mapping[str, float], *groups: Envelopes | None) -> list[dict[str, Envelope]]:
    """Return groups of envelopes in integers of the wire; strokes [m] and envelopes are by ERA."""
    if not any(groups):
        return [{} for _ in groups]
    motions = list[complex]()
    units = list[float]()
    for envelopes in groups:
        for name, envelope in (envelopes or {}).items():
            inner_knots = envelope.knots[:-1]
            motions += inner_knots
            units += [strokes[name]] * len(inner_knots)
    shares = np.array(motions, dtype=complex) / units
    levels = np.rint(np.abs(shares) * _LEVEL.per_unit).astype(int)
    phases = np.rint(np.degrees(np.angle(shares)) * _PHASE.per_unit).astype(int)
    phases[phases > _PHASE.maximum] = _PHASE.minimum  # half a turn
    knots = zip(levels.tolist(), phases.tolist(), strict=True)
    wire_groups = list[dict[str, Envelope]]()
    for envelopes in groups:
        wire_envelopes = dict[str, Envelope]()
        for name, envelope in (envelopes or {}).items():
            step = math.ceil(round(envelope.step * _STEP.per_unit, _DIGITS))
            wire_knots = tuple(islice(knots, len(envelope.knots) - 1))
            wire_envelopes[name] = Envelope(step, wire_knots)
        wire_groups.append(wire_envelopes)
    return wire_groups


def tones_by_era(
    played: Mapping[str, Sequence[LayerSet]], rig: Rig, number: int = 0
) -> dict[str, AmplifierTone]:
    """Return the tones of a layer, by ERA; without silent ones."""
    commands = dict[tuple[str, int], Command]()
    for amplifier, layers in played.items():
        for layer in layers:
            if layer.layer != number:
                continue
            for command in layer.commands:
                if command.level > 0:
                    commands[amplifier, command.channel] = command
    tones = dict[str, AmplifierTone]()
    for name, channel in rig.wiring.items():
        driving = commands.get((channel.amplifier, channel.number))
        if driving is None:
            continue
        tones[name] = AmplifierTone(
            channel.number,
            driving.frequency / _FREQUENCY.per_unit,
            driving.level / _LEVEL.per_unit,
            driving.phase / _PHASE.per_unit,
        )
    return tones


def full_drive(excitation: physics.Excitation, rig: Rig) -> dict[str, AmplifierTone]:
    """Return the tones of an excitation at the share 1 of its course, by ERA."""
    tones = _tones(excitation, rig, restarted_by(excitation, {}))
    return {name: tone for name, tone in tones.items() if name in excitation}
