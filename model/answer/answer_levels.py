"""Levels of an answer: as strong as quiet fingers allow, and within the amplifiers' limits."""

import math
from dataclasses import replace

import numpy as np

from model.answer.answer import IMPERCEPTIBLE_DB_SL, Answer, Limits, amplitudes_of
from model.answer.promise import share_stroke, with_tones
from model.arrays import FloatArray
from model.finger import decibels
from model.table.table import LocalizationTable

_SILENT_DB = -60.0  # gain at which a content is not felt


def as_quiet_fingers_allow(table: LocalizationTable, result: Answer) -> Answer:
    """Set the levels of stimuli with `is_limit` to the highest that the other fingers allow.

    Together they reach at most IMPERCEPTIBLE_DB_SL at quiet fingers, relative to the rig's own
    thresholds, on 90 % of plates. For fingers with their own vibration, none is raised above that
    level, but none is lowered either.
    """
    contents = result.contents
    streams = contents.streams
    tones = result.tones
    limited = [n for n, stream in enumerate(streams) if stream.limit_db_sl is not None]
    foreign_db_sl = tones.foreign_db_sl
    if len(limited) < len(streams):
        limited_alone_db = np.full(len(streams), _SILENT_DB)
        limited_alone_db[limited] = 0.0
        foreign_db_sl = with_gains(table, result, limited_alone_db).tones.foreign_db_sl
    highest_db_sl = IMPERCEPTIBLE_DB_SL - float(decibels(math.sqrt(len(limited))))
    gains_db = np.zeros(len(streams))
    for number in limited:
        stream = streams[number]
        level = min(tones.level_db_sl[finger][0] for finger in stream.targets)
        at_quiet = [foreign_db_sl[finger][0] for finger in contents.quiet]
        at_others = [foreign_db_sl[finger][0] for finger in contents.others(number)]
        allowed = highest_db_sl - max(at_quiet, default=-math.inf)
        raised = highest_db_sl - max(at_others, default=-math.inf)
        gains_db[number] = min((stream.limit_db_sl or 0.0) - level, allowed, max(raised, 0.0))
    return with_gains(table, result, gains_db)


def as_ramps_allow(table: LocalizationTable, result: Answer, limits: Limits) -> Answer:
    """Lengthen the ramps of short stimuli to respect the amplifiers' slew limit.

    Levels are raised in return, except for stimuli with `is_limit`, whose level other fingers set.
    """
    contents = result.contents
    tones = result.tones
    full_levels = table.full_levels
    if contents.is_shaped or all(stream.duration is None for stream in contents.streams):
        return result
    levels = [amplitude / full_levels[name] for name, amplitude in result.amplitudes.items()]
    ramp = max(levels) / limits.slew
    if ramp <= min([layer.ramp for layer in result.layers]):
        return result
    longer = replace(result, contents=replace(contents, least_ramp=ramp))
    rows = np.array(tones.rows, dtype=int)
    owners = np.array(tones.owners, dtype=int)
    may_rise = all(stream.limit_db_sl is None for stream in contents.streams)
    gains = None if may_rise else np.array(tones.gains)
    return with_tones(table, longer, rows, tones.weights, owners, gains)


def gains_within(table: LocalizationTable, result: Answer, limits: Limits) -> FloatArray:
    """Compute gains [dB] on the layers of an answer that bring them within the amplifiers' limits.

    Limits are shared like the stroke: lower priorities are reduced first, and louder layers first
    among equal priorities. A layer's power counts by its share of the total.
    """
    full_levels = table.full_levels
    layer_amplitudes = [amplitudes_of(layer.excitations) for layer in result.layers]
    amplitudes = np.array([[layer[era] for era in full_levels] for layer in layer_amplitudes])
    levels = amplitudes / [*full_levels.values()]
    layer_norms = np.linalg.norm(levels, axis=1)
    total_norm = np.linalg.norm(levels.sum(axis=0))
    power_shares = layer_norms * total_norm / layer_norms.sum()
    highest = limits.amplitudes or full_levels
    amplitude_shares = amplitudes / [highest[era] for era in full_levels]
    excursions = np.array([table.excursion_of(layer.drives) for layer in result.layers])
    used_shares = np.column_stack(
        [
            amplitude_shares,
            power_shares / math.sqrt(limits.power),
            excursions / limits.excursion,
        ]
    )
    first_fingers = [stream.targets[0] for stream in result.contents.streams]
    sensations = result.fingers
    promised_db_sl = np.array([sensations[n].promised_level_db_sl for n in first_fingers])
    factors, _ = share_stroke(
        np.ones(len(first_fingers)),
        used_shares.astype(np.complex64),
        10 ** (promised_db_sl / 20),
        [result.asked[finger].priority for finger in first_fingers],
    )
    return np.maximum(decibels(np.maximum(factors, 1e-9)), _SILENT_DB)


def with_gains(table: LocalizationTable, result: Answer, gains_db: FloatArray) -> Answer:
    """Apply a gain [dB] to each layer of an answer, within the stroke."""
    tones = result.tones
    owners = np.array(tones.owners, dtype=int)
    content_gains = 10 ** (gains_db / 20)
    tone_gains = content_gains[owners] * tones.gains
    era_amplitudes = tone_gains[:, None] * np.abs(np.array(tones.weights))
    stroke = float(era_amplitudes.sum(axis=0).max(initial=0))
    rows = np.array(tones.rows, dtype=int)
    return with_tones(table, result, rows, tones.weights, owners, tone_gains / max(stroke, 1.0))


def scaled(result: Answer, gain_db: float) -> Answer:
    """Apply one gain [dB] to a whole answer; contrasts do not change."""
    tones = result.tones
    factor = 10 ** (gain_db / 20)
    level_db_sl = [[level + gain_db for level in finger] for finger in tones.level_db_sl]
    foreign_db_sl = [[level + gain_db for level in finger] for finger in tones.foreign_db_sl]
    scaled_tones = replace(
        tones,
        gains=[factor * gain for gain in tones.gains],
        level_db_sl=level_db_sl,
        foreign_db_sl=foreign_db_sl,
        stroke_factor=tones.stroke_factor * factor,
    )
    return replace(result, tones=scaled_tones)
