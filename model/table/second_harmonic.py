"""The second harmonic of a bias in the measures of a pattern.

u = b + U sin(w t + theta) squares to 2 b U sin(w t + theta) + U^2 / 2 sin(2 w t + 2 theta - 90
degrees): beside each tone its ERA moves at twice the frequency, everywhere on the plate. Patterns
are chosen without it, since the choice is by tones alone.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.ensemble.attached_plate import attach
from model.ensemble.contact_forms import modal_fields
from model.finger.contrast import contrast_db, mean_level_db_sl
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import sensation_level
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.table import LocalizationTable
from model.vibration.excitation import Excitation
from model.vibration.peak import base_amplitudes, peak_acceleration
from registry.voltage import HIGHEST_FELT, VoltageDrive


def with_second_harmonic(
    pattern: Pattern,
    question: Question,
    table: LocalizationTable,
    voltage: Mapping[str, VoltageDrive],
) -> Pattern:
    """Return a pattern whose levels and contrasts include the harmonics of ERAs with a bias.

    voltage: by ERA. Robust measures are changed by the harmonics of the plate as modelled.
    """
    discs = [fingertip_points(*at, table.plate) for at in question.contacts]
    points = np.concatenate(discs)
    tones, before = table.amplitudes(
        pattern.excitation, points, contacts=question.contacts, loads=question.loads
    )
    every, after = add_second_harmonic(
        pattern.excitation, (tones, before), points, question, table, voltage
    )
    frequencies, added = every[len(tones) :], after[len(tones) :]
    if not len(frequencies):
        return pattern
    ends = np.cumsum([len(disc) for disc in discs])
    count = len(question.targets)

    def level(of: FloatArray, at: FloatArray) -> float:
        parts = np.split(at, ends[:-1], axis=1)[:count]
        return min(
            mean_level_db_sl(of, part, fingertip_weights(*place, table.plate), table.threshold)
            for part, place in zip(parts, question.targets, strict=True)
        )

    louder = level(every, after) - level(tones, before)
    changed = replace(
        pattern,
        level_db_sl=pattern.level_db_sl + louder,
        robust_level_db_sl=_plus(pattern.robust_level_db_sl, louder),
    )
    if not question.quiet:
        return changed
    quiet = slice(ends[count - 1], None)
    harmonics = float(sensation_level(frequencies, added[:, quiet], table.threshold).max())
    nominal = sensation_level(every, after[:, quiet], table.threshold).max()
    nominal -= sensation_level(tones, before[:, quiet], table.threshold).max()
    robust_quiet = pattern.robust_quiet_level_db_sl
    robust = 0.0 if robust_quiet is None else _together(robust_quiet, harmonics) - robust_quiet
    acceleration = _contrast(after, ends, question, table) - _contrast(
        before, ends, question, table
    )
    return replace(
        changed,
        quiet_level_db_sl=_plus(pattern.quiet_level_db_sl, float(nominal)),
        robust_quiet_level_db_sl=_plus(robust_quiet, robust),
        contrast_db=_plus(pattern.contrast_db, acceleration),
        robust_contrast_db=_plus(pattern.robust_contrast_db, acceleration),
        robust_felt_contrast_db=_plus(pattern.robust_felt_contrast_db, louder - robust),
        median_felt_contrast_db=_plus(pattern.median_felt_contrast_db, louder - float(nominal)),
    )


def add_second_harmonic(
    excitation: Excitation,
    tones: tuple[FloatArray, FloatArray],
    points: FloatArray,
    question: Question,
    table: LocalizationTable,
    voltage: Mapping[str, VoltageDrive],
) -> tuple[FloatArray, FloatArray]:
    """Return frequencies (f,) [Hz] and peak acceleration (f, p) [m/s²] with those of harmonics.

    tones: both without them, of an excitation at points under the fingers of a question.
    """
    frequencies, weights = _harmonics(excitation, table, voltage)
    if not len(frequencies):
        return tones
    added = _amplitudes(frequencies, weights, points, question, table)
    return np.concatenate([tones[0], frequencies]), np.vstack([tones[1], added])


def _harmonics(
    excitation: Excitation, table: LocalizationTable, voltage: Mapping[str, VoltageDrive]
) -> tuple[FloatArray, ComplexArray]:
    """Frequencies (f,) [Hz] of harmonics that can be felt, and levels (f, eras) of the bases."""
    frequencies, bases = base_amplitudes(excitation, table.eras)
    levels = bases / [era.stroke for era in table.eras]
    found = np.zeros_like(levels)
    for column, era in enumerate(table.eras):
        drive = voltage.get(era.name)
        if drive is not None and drive.bias:
            found[:, column] = [
                drive.second_harmonic(level, frequency)
                for level, frequency in zip(levels[:, column], frequencies, strict=True)
            ]
    is_felt = (2 * frequencies <= HIGHEST_FELT) & found.any(axis=1)
    return 2 * frequencies[is_felt], found[is_felt]


def _amplitudes(
    frequencies: FloatArray,
    weights: ComplexArray,
    points: FloatArray,
    question: Question,
    table: LocalizationTable,
) -> FloatArray:
    """Peak acceleration (f, p) [m/s²] at points under the fingers of a question."""
    plate = attach(
        table.plate,
        table.omega,
        table.losses,
        table.attachment_shapes,
        eras=table.eras,
        masses=table.masses,
        fingertip=table.fingertip,
        uncertainty=table.uncertainty,
        frequencies=frequencies,
        dispersion=table.modal_dispersion,
    )
    fingers = table.shapes_at(question.contacts).astype(np.float32)
    modal = modal_fields(plate, fingers, question.loads)
    fields = (modal @ weights.astype(np.complex64)[:, :, None])[:, :, 0]
    return np.abs(fields @ table.raster.at(table.shapes, points).T).astype(float)


def _contrast(
    amplitudes: FloatArray, ends: FloatArray, question: Question, table: LocalizationTable
) -> float:
    """Contrast [dB] in acceleration."""
    parts = [peak_acceleration(part) for part in np.split(amplitudes, ends[:-1], axis=1)]
    count = len(question.targets)
    weights = [fingertip_weights(*at, table.plate) for at in question.targets]
    return float(contrast_db(parts[:count], np.concatenate(parts[count:]), weights))


def _together(one: float, other: float) -> float:
    """Level [dB] of two that add in power."""
    return float(10 * np.log10(10 ** (one / 10) + 10 ** (other / 10)))


def _plus(value: float | None, more: float) -> float | None:
    return None if value is None else value + more
