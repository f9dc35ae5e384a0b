"""How strongly vibrations are played: within the amplifiers' limits, and as quiet fingers allow."""

import math
from dataclasses import replace

import numpy as np

from model.answer.answer import IMPERCEPTIBLE_DB_SL, Answer, Limits, amplitudes_of
from model.answer.promised import share_stroke, with_tones
from model.arrays import FloatArray
from model.finger import decibels
from model.table.table import LocalizationTable

_SILENT_DB = -60.0  # a gain by which a content is not felt


def as_quiet_fingers_allow(table: LocalizationTable, found: Answer) -> Answer:
    """Return an answer whose stimuli that are limits are as strong as the others allow.

    Quiet fingers have IMPERCEPTIBLE_DB_SL, by the rig's own thresholds, of all of them together at
    most, on nine of ten plates. For those that feel a vibration of their own none is raised above
    that, nor lowered.
    """
    streams, tones = found.contents.streams, found.tones
    limited = [n for n, each in enumerate(streams) if each.limit_db_sl is not None]
    heard = tones.foreign_db_sl
    if len(limited) < len(streams):  # of these alone
        alone = np.full(len(streams), _SILENT_DB)
        alone[limited] = 0.0
        heard = with_gains(table, found, alone).tones.foreign_db_sl
    gains_db = np.zeros(len(streams))
    for number in limited:
        stream = streams[number]
        level = min(tones.level_db_sl[finger][0] for finger in stream.targets)
        highest = IMPERCEPTIBLE_DB_SL - float(decibels(math.sqrt(len(limited))))
        quiet, others = found.contents.quiet, found.contents.others(number)
        allowed = highest - max([heard[finger][0] for finger in quiet], default=-math.inf)
        raised = highest - max([heard[finger][0] for finger in others], default=-math.inf)
        gains_db[number] = min((stream.limit_db_sl or 0.0) - level, allowed, max(raised, 0.0))
    return with_gains(table, found, gains_db)


def scaled(found: Answer, gain_db: float) -> Answer:
    """Return an answer louder by so much [dB]: contrasts stay."""
    tones, factor = found.tones, 10 ** (gain_db / 20)
    louder = replace(
        tones,
        gains=[factor * each for each in tones.gains],
        level_db_sl=[[each + gain_db for each in levels] for levels in tones.level_db_sl],
        foreign_db_sl=[[each + gain_db for each in by_set] for by_set in tones.foreign_db_sl],
        stroke_factor=tones.stroke_factor * factor,
    )
    return replace(found, tones=louder)


def with_gains(table: LocalizationTable, found: Answer, gains_db: FloatArray) -> Answer:
    """Return an answer with a gain on each layer, within the stroke."""
    tones = found.tones
    gains = 10 ** (gains_db / 20)
    owners = np.array(tones.owners, dtype=int)
    by_tone = gains[owners] * tones.gains
    stroke = float((by_tone[:, None] * np.abs(np.array(tones.weights))).sum(axis=0).max(initial=0))
    every = np.array(tones.rows, dtype=int), tones.weights, owners, by_tone / max(stroke, 1.0)
    return with_tones(table, found, *every)


def gains_within(table: LocalizationTable, found: Answer, limits: Limits) -> FloatArray:
    """Gains [dB] on the layers of an answer by which they are within the amplifiers' limits.

    As the stroke is shared: those of lower priority are lowered first, of equal ones the louder.
    Power counts in shares of what all together would have.
    """
    strokes = table.full_levels
    each_layer = [amplitudes_of(layer.excitations) for layer in found.layers]
    amplitudes = np.array([[each[name] for name in strokes] for each in each_layer])
    levels = amplitudes / [*strokes.values()]
    norms = np.linalg.norm(levels, axis=1)
    power = norms * np.linalg.norm(levels.sum(axis=0)) / norms.sum()
    highest = limits.amplitudes or strokes
    full = amplitudes / [highest[name] for name in strokes]
    ways = np.array([table.excursion_of(layer.drives) for layer in found.layers])
    limited = np.column_stack([full, power / math.sqrt(limits.power), ways / limits.excursion])
    streams = found.contents.streams
    promised = np.array([found.fingers[each.targets[0]].promised_level_db_sl for each in streams])
    factors, _ = share_stroke(
        np.ones(len(streams)),
        limited.astype(np.complex64),
        10 ** (promised / 20),
        [found.asked[each.targets[0]].priority for each in streams],
    )
    return np.maximum(decibels(np.maximum(factors, 1e-9)), _SILENT_DB)


def as_ramps_allow(table: LocalizationTable, found: Answer, limits: Limits) -> Answer:
    """Return an answer whose short stimuli are raised along ramps that the slew allows.

    None is raised where one is as strong as the others allow, which they feel as long.
    """
    contents, tones, strokes = found.contents, found.tones, table.full_levels
    if contents.is_shaped or all(stream.duration is None for stream in contents.streams):
        return found
    ramp = max([tone / strokes[name] for name, tone in found.amplitudes.items()]) / limits.slew
    if ramp <= min([layer.ramp for layer in found.layers]):
        return found
    longer = replace(found, contents=replace(contents, least_ramp=ramp))
    rows, owners = np.array(tones.rows, dtype=int), np.array(tones.owners, dtype=int)
    is_free = all(stream.limit_db_sl is None for stream in contents.streams)
    gains = None if is_free else np.array(tones.gains)
    return with_tones(table, longer, rows, tones.weights, owners, gains)
