"""Fingers on a table's plate: their forms to search, and what they feel on drawn plates.

What fingers feel of the tones of all contents on drawn plates, and what is promised of it.

How strongly vibrations are played: within the amplifiers' limits, and as quiet fingers allow.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from model.answer.answer import (
    IMPERCEPTIBLE_DB_SL,
    Answer,
    Limits,
    RingingUnderFingers,
    amplitudes_of,
    on_drawn_plates,
    shaped_gain,
)
from model.answer.stimulus import PROMISED_PERCENTILE, Contents, Tones
from model.arrays import NEARLY, Complex64Array, Float32Array, FloatArray, IntArray, Point
from model.drive_modes import Forms
from model.ensemble.attached_plate import PlateOnEras
from model.ensemble.draws import PROMISED_DRAWS, Drawing, over_fingertips, percentile
from model.ensemble.touched_plate import (
    FingertipAmplitudes,
    LoadedContacts,
    TouchedPlate,
    outer,
    touch,
)
from model.finger import decibels
from model.table.table import FingertipShapes, LocalizationTable, read_fingertips

MAX_FINGERS_BY_POINT = 4
"""Quiet fingers up to which the points of each are looked at one by one in a search."""

CENTRE_AND_RIM, CENTRE_AND_FOUR = np.array([0, *range(9, 21)]), np.array([0, 9, 12, 15, 18])
"""Of the fine points of a fingertip, those between which no null hides, and a few of them."""

MAX_VARIANCE_FINE = 0.005
"""Variance of an ERA's gain up to which nulls are so deep that few points do not show them."""


@dataclass(frozen=True, eq=False)
class FingersOnPlate:
    """The plate of a table with k fingers on it, and the shapes under these.

    at_harmonics: the same at twice the table's frequencies; None where ERAs have no harmonics.
    """

    table: LocalizationTable
    tips: FingertipShapes
    touched: TouchedPlate
    at_harmonics: TouchedPlate | None

    @classmethod
    def of(
        cls,
        table: LocalizationTable,
        places: Sequence[Point],
        loads: tuple[float, ...],
        *,
        by_kernel: bool = True,
    ) -> "FingersOnPlate":
        """Put fingers at places [m] on a table's plate.

        loads: of each relative to the rig's fingertip, empty for 1.
        """
        if by_kernel:
            tips = read_fingertips(table, places)
        else:
            tips = table.raster.fingertips(np.array(places), table.shapes)
        centres = tips.few[:, 0]

        def touched(on: PlateOnEras) -> TouchedPlate:
            if by_kernel:
                return touch(on, centres, loads, table.clocks)
            stiffness = on.plate.finger_stiffness(len(centres), loads)
            return TouchedPlate(on, centres, stiffness, table.clocks)

        has_harmonics = table.uncertainty.harmonic > 0
        twice = touched(table.at_harmonics) if has_harmonics else None
        return cls(table, tips, touched(table.on_eras), twice)

    def forms(self, rows: IntArray, *, with_fine: bool) -> "FingerForms":
        """What the fingers have of the ERAs at rows (f,) of the table's frequencies.

        with_fine: at their fine points, too.
        """
        tips, fine = self.tips, self.tips.fine if with_fine else None
        power = self.table.search_error_power
        return FingerForms(
            self, rows, self.touched.forms(rows, tips.few, tips.few_weights, power, fine)
        )

    def drawn(
        self, by: Drawing, rows: IntArray, weights: Complex64Array, *, with_powers: bool = False
    ) -> FingertipAmplitudes:
        """What tones at rows (m,) of weights (m, n) do at all fine points on drawn plates."""
        points, table = self.tips.fine.reshape(-1, self.tips.fine.shape[2]), self.table
        given = points, self.tips.fine_weights, table.error_power, table.thresholds
        return self.touched.drawn(by, rows, weights, *given, with_powers=with_powers)

    def felt(
        self, by: Drawing, rows: IntArray, weights: Complex64Array, owners: IntArray
    ) -> tuple[Float32Array, Float32Array]:
        """Mean amplitude over each fingertip, and power at its loudest point, of c drives.

        With the second harmonics in the latter.

        owners (m,): the drive of each tone, ascending; both (c, k, 1 + d).
        """
        starts = np.flatnonzero(np.diff(owners, prepend=-1))
        harmonics = np.add.reduceat(self.harmonics(by, rows, weights), starts)
        if len(rows) == 1 + owners[-1]:
            sensed = self.drawn(by, rows, weights)
            return sensed.means, sensed.loudest + harmonics
        power = self.powers(by, rows, weights).reshape(len(rows), -1, 1 + by.count)
        means, loudest = over_fingertips(np.add.reduceat(power, starts), self.tips.fine_weights)
        return means, loudest + harmonics

    def harmonics(self, by: Drawing, rows: IntArray, weights: Complex64Array) -> Float32Array:
        """Squared amplitude to threshold of second harmonics at fingers, (m, k, 1 + d).

        To `compared_harmonic_thresholds`.
        """
        if self.at_harmonics is None:
            return np.zeros((len(rows), len(self.tips.few), 1 + by.count), dtype=np.float32)
        tips, threshold = self.tips, self.table.compared_harmonic_thresholds[rows]
        found = self.at_harmonics.harmonics(by, rows, weights, tips.few, tips.few_weights)
        return np.asarray(found / np.square(threshold)[:, None, None])

    def powers(self, by: Drawing, rows: IntArray, weights: Complex64Array) -> Float32Array:
        """Squared amplitudes to threshold of tones at fine points, (m, k, p, 1 + d)."""
        found = self.drawn(by, rows, weights, with_powers=True).powers
        return np.asarray(found).reshape(len(rows), *self.tips.fine_weights.shape, -1)


@dataclass(frozen=True, eq=False)
class FingerForms:
    """Fields and expected powers at fingers, at rows (f,) of a table's frequencies."""

    fingers: FingersOnPlate
    rows: IntArray
    contacts: LoadedContacts

    def at(self, some: IntArray) -> "FingerForms":
        """Select some of the frequencies, by index (n,)."""
        of, fine = self.contacts, self.contacts.fine_fields
        contacts = LoadedContacts(
            of.fields[some],
            None if fine is None else fine[some],
            of.power[some],
            of.uncertain[some],
        )
        return replace(self, rows=self.rows[some], contacts=contacts)

    def of(
        self,
        targets: Sequence[int],
        others: Sequence[int],
        level_db_sl: float,
        background: Complex64Array | None = None,
    ) -> Forms:
        """Forms to search for fingers, by index, that are targets and others that are not.

        background (f, n, n): form of the rest of the plate, for no other finger.
        """
        targets, others = [*targets], [*others]
        contacts, tips, table = self.contacts, self.fingers.tips, self.fingers.table
        weights = tips.few_weights[targets]
        mean = (weights[:, None] @ contacts.fields[:, targets])[:, :, 0]
        # What the field differs over a target is no uncertainty of its level.
        expected = contacts.uncertain[:, targets] + outer(mean)
        found = Forms(
            mean.swapaxes(0, 1),
            expected.swapaxes(0, 1),
            contacts.power[:, others],
            table.thresholds.take(self.rows),
            10 ** (level_db_sl / 20),
        )
        variance = table.uncertainty.gain_variance
        if background is not None:
            rest = background.copy()
            rest.reshape(len(rest), -1)[:, :: rest.shape[1] + 1] *= 1 + np.float32(variance)
            return replace(found, quiet=rest[:, None])
        is_deep = variance < MAX_VARIANCE_FINE and len(others) <= MAX_FINGERS_BY_POINT
        if not is_deep or contacts.fine_fields is None:
            return found
        few = contacts.fields[:, others] * np.sqrt(tips.few_weights[others][:, :, None])
        return replace(found, few=few, fine=contacts.fine_fields[:, others])

    def by_point(
        self, forms: Forms, others: Sequence[int], points: IntArray = CENTRE_AND_RIM
    ) -> Forms:
        """Forms by point of every finger that is no target; points (p,): of the fine ones.

        What is uncertain counts by the fingertip's mean.
        """
        fine, n = np.asarray(self.contacts.fine_fields), forms.era_count
        quiet = self.contacts.uncertain[:, others, None] + outer(fine[:, others][:, :, points])
        found = replace(forms, quiet=quiet.reshape(len(fine), -1, n, n), few=None, fine=None)
        return found if forms.driven is None else found.among(forms.driven)


MIN_RAISED_CONTRAST_DB = 6.0
"""Contrast over an effect down to which its drive is raised: quiet fingers feel half of it."""

_TINY = 1e-20


def with_tones(
    table: LocalizationTable,
    found: Answer,
    rows: IntArray,
    weights: Sequence[Sequence[complex]],
    owners: IntArray,
    gains: FloatArray | None,
) -> Answer:
    """The answer with other tones, and what these promise together, on the same plates.

    gains: None for those to the contents' levels.
    """
    contents = found.contents
    fingers = FingersOnPlate.of(table, contents.places, contents.loads)
    of_tones = rows, np.array(weights, dtype=np.complex64), owners
    ringing = RingingUnderFingers.of_streams(table, contents)
    tones = promised(fingers, contents, *of_tones, gains=gains, ringing=ringing)
    factor = tones.stroke_factor if gains is None else found.stroke_factor
    return replace(found, tones=replace(tones, stroke_factor=factor))


def promised(
    fingers: FingersOnPlate,
    contents: Contents,
    rows: IntArray,
    weights: Complex64Array,
    owners: IntArray,
    *,
    is_apart: bool = True,
    gains: FloatArray | None = None,
    ringing: Sequence[RingingUnderFingers | None] = (),
) -> Tones:
    """What fingers feel of tones at rows (m,) of weights (m, n), at gains (m,).

    owners (m,): the content of each tone; gains: None for those to the contents' levels; ringing:
    of the contents that have a duration.
    """
    shares, streams = fingers.tips.fine_weights, contents.streams
    steady = power = fingers.powers(PROMISED_DRAWS, rows, weights)
    harmonics = fingers.harmonics(PROMISED_DRAWS, rows, weights)
    if any(stream.duration is not None for stream in streams):
        over = fingers, contents, steady, harmonics, rows, weights, owners, ringing
        power, harmonics = _over_durations(*over)
    by_tone, factor = gains, 1.0
    if by_tone is None:
        of_contents, factor = _gains_to_levels(
            contents, power, steady, harmonics, shares, rows, weights, owners
        )
        by_tone = of_contents[owners]
    squares = np.square(by_tone, dtype=np.float32)[:, None, None]
    power, harmonics, table = power * squares[..., None], harmonics * squares, fingers.table
    sensitivities = table.sensitivities[:, rows], table.harmonic_sensitivities[:, rows]
    by_set = [
        _compared(
            contents,
            power * np.square(at_tones)[:, None, None, None],
            harmonics * np.square(at_harmonics)[:, None, None],
            shares,
            rows,
            owners,
        )
        for at_tones, at_harmonics in zip(*sensitivities, strict=True)
    ]
    (level, *_), contrast, of_others, worst = map(np.array, zip(*by_set, strict=True))
    return Tones(
        rows=rows.tolist(),
        weights=weights.tolist(),
        gains=by_tone.tolist(),
        owners=owners.tolist(),
        contrast_db=decibels(contrast.min(axis=0)).tolist(),
        level_db_sl=decibels(level).tolist(),
        foreign_db_sl=decibels(of_others.T).tolist(),
        worst_db=float(decibels(worst.min())),
        stroke_factor=factor,
        is_apart=is_apart,
    )


def _compared(
    contents: Contents,
    power: Float32Array,
    harmonics: Float32Array,
    shares: Float32Array,
    rows: IntArray,
    owners: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Level (k, 2), contrast (k, 3), what is felt of others (k,), and promised of all fingers.

    By one set of thresholds, to which power (m, k, p, d) and that of harmonics (m, k, d) are; NaN
    where there is nothing to compare.
    """
    streams, k = contents.streams, len(contents.places)
    level, contrast, of_others = (np.full(size, np.nan) for size in ((k, 2), (k, 3), k))
    own_of = {finger: owners == j for j, stream in enumerate(streams) for finger in stream.targets}
    every = {
        finger: felt_amplitudes(power, shares, rows, own, (finger,))
        for finger, own in own_of.items()
    }
    level[[*every]] = [(felt[0], promise(felt)) for felt in every.values()]
    ratios: list[Float32Array] = []
    for finger in (*every, *contents.quiet):
        felt = every[finger] if finger in every else np.min([*every.values()], axis=0)
        others = ~own_of.get(finger, np.zeros(len(rows), dtype=bool))
        if not others.any():
            continue
        heard = loudest_power(power[others], harmonics[others], rows[others], finger)
        heard = np.sqrt(np.maximum(heard, _TINY))
        ratios.append(felt / heard)
        of_others[finger] = promise(heard, 100 - PROMISED_PERCENTILE)
        contrast[finger] = figures(ratios[-1])
    worst = figures(np.min(ratios, axis=0)) if ratios else (np.nan,) * 3
    if len(streams) == 1:
        contrast[[*streams[0].targets]] = worst  # the one at the loudest quiet finger
    return level, contrast, of_others, worst[2]


def _over_durations(
    fingers: FingersOnPlate,
    contents: Contents,
    steady: Float32Array,
    harmonics: Float32Array,
    rows: IntArray,
    weights: Complex64Array,
    owners: IntArray,
    ringing: Sequence[RingingUnderFingers | None],
) -> tuple[Float32Array, Float32Array]:
    """Power (m, k, p, d) of tones over the durations of their contents, and of harmonics (m, k, d).

    By the energy of the tones in their spectrum, on each plate.
    """
    power, harmonics = steady.copy(), harmonics.copy()
    shares = fingers.tips.fine_weights
    for tone, owner in enumerate(owners.tolist()):
        stream, over = contents.streams[owner], ringing[owner]
        if stream.duration is None:
            continue
        if over is None:  # along a shaped onset
            factor = np.float32(shaped_gain(stream.duration) ** 2)
            power[tone] *= factor
            harmonics[tone] *= factor
            continue
        own, drive = [*stream.targets], [(int(rows[tone]), weights[tone])]
        felt = over.over_drive(drive)
        near, beside = zip(*over.spectrum(drive), strict=True)
        energy = fingers.powers(PROMISED_DRAWS, np.array(near), np.array(beside)).sum(axis=0)
        lasting, nominal = (
            (shares[own] * np.sqrt(each[own, :, 0])).sum(axis=1) for each in (steady[tone], energy)
        )
        by_target = np.square(felt.gains[own] * lasting / np.maximum(nominal, _TINY))
        power[tone] = on_drawn_plates(energy, felt.heard, by_target.min())
        power[tone, own] = energy[own] * by_target[:, None, None]
        harmonics[tone] *= np.float32(felt.gains[own].min() ** 2)
    return power, harmonics


def _gains_to_levels(
    contents: Contents,
    power: Float32Array,
    steady: Float32Array,
    harmonics: Float32Array,
    shares: Float32Array,
    rows: IntArray,
    weights: Complex64Array,
    owners: IntArray,
) -> tuple[FloatArray, float]:
    """Gains (K,) of contents to their levels on nine of ten plates, as `share_stroke`."""
    streams, levels = contents.streams, contents.levels.astype(float)
    alone = np.arange(len(owners))  # as if each had a frequency of its own
    gains = np.empty(len(streams))
    for j, stream in enumerate(streams):
        felt = felt_amplitudes(power, shares, alone, owners == j, stream.targets)
        if stream.duration is None:
            gains[j] = levels[j] / max(promise(felt), 1e-30)
            continue
        lasting = felt_amplitudes(steady, shares, alone, owners == j, stream.targets)
        gains[j] = levels[j] / max(felt[0], 1e-30)
        if others := contents.others(j):
            own = owners == j
            of_own = power[own], harmonics[own], rows[own]
            at = [loudest_power(*of_own, each) for each in others]
            contrast = promise(felt / np.sqrt(np.maximum(np.max(at, axis=0), _TINY)))
            allowed = _allowed_gain(levels[j], float(felt[0]), contrast)
            gains[j] = min(gains[j], max(allowed, levels[j] / max(promise(lasting), 1e-30)))
    drives = np.zeros((len(streams), weights.shape[1]))
    np.add.at(drives, owners, np.abs(weights))
    priorities = [stream.priority for stream in streams]
    return share_stroke(gains, drives, levels, priorities)


def _allowed_gain(level: float, felt: float, contrast: float) -> float:
    """Gain up to which quiet fingers allow a short stimulus: they feel half of it at most.

    Or nothing. level: of it, felt: of its drive, as amplitudes to threshold, contrast: promised.
    """
    highest = max(level * 10 ** (-MIN_RAISED_CONTRAST_DB / 20), 10 ** (IMPERCEPTIBLE_DB_SL / 20))
    return highest * contrast / max(felt, 1e-30)


def share_stroke(
    gains: FloatArray,
    weights: Complex64Array | FloatArray,
    levels: FloatArray,
    priorities: Sequence[int],
) -> tuple[FloatArray, float]:
    """Gains (K,) to levels (K,) within the stroke, and the least factor on them.

    Of each priority the louder contents are lowered first, to one level (max-min), until all fit
    into what is left by the higher ones.
    """
    amplitudes = gains[:, None] * np.abs(weights)
    factors, left = np.zeros(len(gains)), np.ones(amplitudes.shape[1])
    for priority in sorted({*priorities}, reverse=True):
        of = np.array(priorities) == priority
        level, is_lowered = 0.0, of
        while is_lowered.any():
            kept = amplitudes[of & ~is_lowered].sum(axis=0)
            per_level = (amplitudes[is_lowered] / levels[is_lowered, None]).sum(axis=0)
            level = float((np.maximum(left - kept, 0) / np.maximum(per_level, 1e-30)).min())
            if (levels[is_lowered] > level).all():
                break
            is_lowered = is_lowered & (levels > level)
        factors[of] = np.where(is_lowered[of], level / levels[of], 1.0)
        used = factors[of] @ amplitudes[of]
        left = np.where(used >= left * (1 - NEARLY), 0.0, left - used)  # rounding leaves no stroke
    return gains * factors, float(factors.min())


def felt_amplitudes(
    power: Float32Array,
    shares: Float32Array,
    rows: IntArray,
    is_own: NDArray[np.bool_],
    targets: Sequence[int],
) -> Float32Array:
    """The least that a content's fingertips feel of its own tones, (d,), of power (m, k, p, d).

    shares (k, p): of the points in the mean. Tones of other contents at its frequencies, by rows
    (m,), may cancel part of it.
    """
    squares = np.zeros(power.shape[1:], dtype=power.dtype)
    for tone in np.flatnonzero(is_own).tolist():
        amplitude = np.sqrt(power[tone])
        for other in np.flatnonzero(~is_own & (rows == rows[tone])).tolist():
            amplitude = amplitude - np.sqrt(power[other])
        squares += np.maximum(amplitude, 0) ** 2
    return np.asarray(np.min([shares[t] @ np.sqrt(squares[t]) for t in targets], axis=0))


def loudest_power(
    power: Float32Array, harmonics: Float32Array, rows: IntArray, finger: int
) -> Float32Array:
    """Power (d,) of contents at the loudest point of a finger, of power (j, k, p, d).

    Of contents of one frequency, by rows (j,), the amplitudes add. With that of their second
    harmonics over the fingertip, (j, k, d), of any phase.
    """
    at = power[:, finger]
    total = np.zeros(at.shape[1:], dtype=at.dtype)
    order = np.argsort(rows, kind="stable").tolist()
    for _, same in groupby(order, key=rows.__getitem__):
        total += np.sqrt(at[list(same)]).sum(axis=0) ** 2
    return np.asarray(total.max(axis=0) + harmonics[:, finger].sum(axis=0))


def promise(values: Float32Array, percent: float = PROMISED_PERCENTILE) -> float:
    """Percentile of the drawn plates, without the first, the nominal one."""
    return float(percentile(values[1:].astype(float), percent))


def figures(ratio: Float32Array) -> tuple[float, float, float]:
    """Of ratios (1 + d,): nominal, of half of the drawn plates, of nine of ten."""
    return float(ratio[0]), promise(ratio, 50), promise(ratio)


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
