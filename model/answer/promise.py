"""Compute the sensation of tones on the nominal plate and on drawn plates, and promise it.

`FingersOnPlate` puts fingers on a table's plate. Its forms are the input of a search for tones
(`FingerForms`, and `RingingUnderFingers` for drives of limited duration). From the tones of all
contents, `promised` computes levels, contrasts and the gains for the contents' levels.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from model.answer.answer import (
    IMPERCEPTIBLE_DB_SL,
    PROMISED_PERCENTILE,
    Answer,
    Contents,
    Tones,
)
from model.answer.stimulus import DriveEnvelope, OverDuration, pulse_ramp, shaped_gain
from model.arrays import (
    NEARLY,
    Complex64Array,
    ComplexArray,
    Float32Array,
    FloatArray,
    IntArray,
    Point,
)
from model.drive_modes import Forms, WeightedTones
from model.ensemble.attached_plate import PlateOnEras
from model.ensemble.draws import PROMISED_DRAWS, Drawing, over_fingertips, percentile
from model.ensemble.expected_power import outer
from model.ensemble.kernel_plates import touch
from model.ensemble.touched_plate import FingertipAmplitudes, LoadedContacts, TouchedPlate
from model.finger import decibels, detection_threshold
from model.structure.attachments import fingertip_loads
from model.table.table import FingertipShapes, LocalizationTable, read_fingertips
from model.transients.time_response import enveloped_accelerations

CENTRE_AND_RIM, CENTRE_AND_FOUR = np.array([0, *range(9, 21)]), np.array([0, 9, 12, 15, 18])
"""Indices of fine points of a fingertip between which no null can hide, and of a few points."""

MAX_FINGERS_BY_POINT = 4
"""Maximum number of quiet fingers whose points a search considers individually."""

MAX_VARIANCE_FINE = 0.005
"""Variance of an ERA's gain below which nulls are so deep that few points do not show them."""

_BESIDE_HZ, _LEAST_SHARE = 60.0, 1e-3
"""Maximum distance of frequencies that count for a drive, and their minimum fraction of the power
of its strongest moments."""

_LEAST_PERIODS = 1.7  # beyond this, by 1/duration of a pulse, is 1.4 % of its energy

MIN_RAISED_CONTRAST_DB = 6.0
"""Minimum contrast [dB] when the drive of a short stimulus is raised: others feel half of it."""

_TINY = 1e-20

SIDE_BANDS = 0.02
"""Fraction of a content's power, for one ERA, in side bands at other fingers while weights change.

For n ERAs it is divided by n: their changes have no common phase, unlike their fields at their own
finger. The value is fitted to plates solved in time, so that 90 % of the promises on a path hold.
"""


@dataclass(frozen=True, eq=False)
class FingersOnPlate:
    """Plate of a table with k fingers on it."""

    table: LocalizationTable
    tips: FingertipShapes
    """Mode shapes under the fingers."""
    touched: TouchedPlate
    at_harmonics: TouchedPlate | None
    """Plate at twice the table's frequencies, None if ERAs have no harmonics."""

    @classmethod
    def of(
        cls,
        table: LocalizationTable,
        places: Sequence[Point],
        loads: tuple[float, ...],
        *,
        by_kernel: bool = True,
    ) -> "FingersOnPlate":
        """Put fingers at positions [m] on a table's plate.

        loads: relative to the rig's fingertip, empty for 1 each; by_kernel: whether to use C
        kernels.
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
            return TouchedPlate(
                on, centres, stiffness, on.plate.load_stds(len(centres), loads), table.clocks
            )

        has_harmonics = table.uncertainty.harmonic > 0
        twice = touched(table.at_harmonics) if has_harmonics else None
        return cls(table, tips, touched(table.on_eras), twice)

    def forms(self, rows: IntArray, *, with_fine: bool) -> "FingerForms":
        """Compute fields and expected powers at rows (f,) of the table's frequencies.

        with_fine: also at the fine points of fingertips.
        """
        tips, fine = self.tips, self.tips.fine if with_fine else None
        power = self.table.search_error_power
        return FingerForms(
            self, rows, self.touched.forms(rows, tips.few, tips.few_weights, power, fine)
        )

    def drawn(
        self, by: Drawing, rows: IntArray, weights: Complex64Array, *, with_powers: bool = False
    ) -> FingertipAmplitudes:
        """Compute amplitudes at all fine points on drawn plates, for tones at rows (m,).

        weights (m, n): of the ERAs.
        """
        points, table = self.tips.fine.reshape(-1, self.tips.fine.shape[2]), self.table
        given = points, self.tips.fine_weights, table.error_power, table.thresholds
        return self.touched.drawn(by, rows, weights, *given, with_powers=with_powers)

    def felt(
        self, by: Drawing, rows: IntArray, weights: Complex64Array, owners: IntArray
    ) -> tuple[Float32Array, Float32Array]:
        """Return mean amplitude over fingertips and power at the loudest points, for c drives.

        Both (c, k, 1 + d) relative to the threshold; the power includes second harmonics. owners
        (m,): the drive of each tone, ascending.
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
        """Squared amplitude of second harmonics at fingers, (m, k, 1 + d).

        Relative to the table's `compared_harmonic_thresholds`.
        """
        if self.at_harmonics is None:
            return np.zeros((len(rows), len(self.tips.few), 1 + by.count), dtype=np.float32)
        tips, threshold = self.tips, self.table.compared_harmonic_thresholds[rows]
        found = self.at_harmonics.harmonics(by, rows, weights, tips.few, tips.few_weights)
        return np.asarray(found / np.square(threshold)[:, None, None])

    def powers(self, by: Drawing, rows: IntArray, weights: Complex64Array) -> Float32Array:
        """Squared amplitudes of tones at fine points relative to the threshold, (m, k, p, 1 +
        d)."""
        found = self.drawn(by, rows, weights, with_powers=True).powers
        return np.asarray(found).reshape(len(rows), *self.tips.fine_weights.shape, -1)


@dataclass(frozen=True, eq=False)
class FingerForms:
    """Fields and expected powers at fingers, at rows (f,) of a table's frequencies."""

    fingers: FingersOnPlate
    rows: IntArray
    contacts: LoadedContacts

    def of(
        self,
        targets: Sequence[int],
        others: Sequence[int],
        level_db_sl: float,
        background: Complex64Array | None = None,
    ) -> Forms:
        """Return the forms of a search for targets and other fingers, both by index.

        background (f, n, n): form of the rest of the plate, if there are no other fingers.
        """
        targets, others = [*targets], [*others]
        contacts, tips, table = self.contacts, self.fingers.tips, self.fingers.table
        weights = tips.few_weights[targets]
        mean = (weights[:, None] @ contacts.fields[:, targets])[:, :, 0]
        # The field's variation over a target does not make its level uncertain.
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
        """Return forms in which each point of every other finger counts separately.

        points (p,): indices of fine points. Uncertainty counts by the mean over the fingertip.
        """
        fine, n = np.asarray(self.contacts.fine_fields), forms.era_count
        quiet = self.contacts.uncertain[:, others, None] + outer(fine[:, others][:, :, points])
        found = replace(forms, quiet=quiet.reshape(len(fine), -1, n, n), few=None, fine=None)
        return found if forms.driven is None else found.among(forms.driven)


@dataclass(frozen=True, eq=False)
class RingingUnderFingers:
    """Drives along an envelope on a table's plate with fingers.

    The envelope is represented by tones at the table's frequencies near the drive's. Weights are
    searched and drawn plates evaluated with these tones (`DriveEnvelope.shares_at`).
    """

    table: LocalizationTable
    places: tuple[Point, ...]
    """Positions of the fingers [m]."""
    loads: tuple[float, ...]
    """Loads relative to the rig's fingertip, empty for 1 each."""
    envelope: DriveEnvelope
    _solved: dict[tuple[tuple[int, bytes], ...], OverDuration] = field(default_factory=dict)

    @classmethod
    def of_streams(
        cls, table: LocalizationTable, contents: Contents
    ) -> list["RingingUnderFingers | None"]:
        """Build one for each content with a duration; None for continuous or shaped ones."""
        found: list[RingingUnderFingers | None] = []
        for stream in contents.streams:
            envelope: DriveEnvelope | None = None
            if stream.course is not None:
                envelope = DriveEnvelope.of_course(stream.course)
            elif stream.duration is not None and not contents.is_shaped:
                ramp = max(pulse_ramp(stream.duration), contents.least_ramp)
                envelope = DriveEnvelope.of_pulse(stream.duration, ramp)
            fingers = table, contents.places, contents.loads
            found.append(None if envelope is None else cls(*fingers, envelope))
        return found

    @cached_property
    def shares(self) -> FloatArray:
        """Fraction (f, f) of a drive's steady power in tones at each of the table's frequencies.

        One row per frequency that the drive can have.
        """
        hertz, known = self.table.frequencies, dict[tuple[float, ...], FloatArray]()
        ends = (hertz <= hertz[0] + _BESIDE_HZ).sum(), (hertz >= hertz[-1] - _BESIDE_HZ).sum()
        beyond = int(max(ends)) - 1
        wide = np.pad(hertz, beyond, mode="reflect", reflect_type="odd")
        # Tones beyond the table's ends are reflected into it.
        rows = np.pad(np.arange(len(hertz)), beyond, mode="reflect")
        found = np.zeros((len(hertz), len(hertz)))
        for own, at in enumerate(hertz.tolist()):
            off = np.round(wide - at, 6)
            near = np.abs(off) <= _BESIDE_HZ
            key = tuple(off[near].tolist())
            if key not in known:
                known[key] = self.envelope.shares_at(off[near])
            np.add.at(found[own], rows[near], known[key])
        strongest = self.envelope.moments(self.envelope.values**2).max()
        found[found < _LEAST_SHARE * strongest] = 0.0
        return found

    def spectrum(self, drive: WeightedTones) -> WeightedTones:
        """Return steady tones with the energy of a drive along the envelope, on any plate.

        By Parseval's theorem, except for frequencies far from the drive's. Amplitudes are compared
        with the threshold at the drive's own frequency.
        """
        found, thresholds = [], self.table.thresholds
        for own, weights in drive:
            for row in np.flatnonzero(self.shares[own]).tolist():
                factor = math.sqrt(self.shares[own, row]) * thresholds[row] / thresholds[own]
                found.append((row, np.asarray(factor * weights, dtype=np.complex64)))
        return found

    def forms(self, steady: Forms, some: IntArray) -> Forms:
        """Return forms over the envelope at some rows, from steady forms at all frequencies."""
        shares, own = self.shares[some].astype(np.float32), np.sqrt(self.shares[some, some])
        size = (np.abs(steady.targets) ** 2).sum(axis=(0, 2))
        gain = np.sqrt(shares @ size / np.maximum(size[some], 1e-30))
        found, by_carrier = steady.at(some), own.astype(np.float32)[:, None, None, None]
        return replace(
            found,
            targets=found.targets * gain[:, None],
            quiet=(shares @ steady.quiet.reshape(len(steady.quiet), -1)).reshape(found.quiet.shape),
            level_margin=0.0,
            few=None if found.few is None else found.few * by_carrier,
            fine=None if found.fine is None else found.fine * by_carrier,
        )

    def lasting_long_enough(self, some: IntArray) -> IntArray:
        """Return the rows whose spectrum does not reach down to 0 Hz; all rows if every spectrum
        does.

        A drive of fewer periods moves the plate as a whole, which no frequency of a table shows.
        """
        hertz, envelope = self.table.frequencies[some], self.envelope
        long = (
            some
            if envelope.is_course
            else some[hertz * envelope.within * envelope.step >= _LEAST_PERIODS]
        )
        return long if len(long) else some

    def over_drive(self, drive: WeightedTones) -> OverDuration:
        """Return the sensation of a drive over the duration; each drive is solved once."""
        hertz, drives = self.table.frequencies, self.table.highest_drives
        key = tuple([(row, weights.tobytes()) for row, weights in drive])
        if key not in self._solved:
            self._solved[key] = self.over(
                [
                    (float(hertz[row]), np.multiply(weights, drives[row], dtype=complex))
                    for row, weights in drive
                ]
            )
        return self._solved[key]

    def over(self, tones: Iterable[tuple[float, ComplexArray]]) -> OverDuration:
        """Solve the sensation of simultaneous tones: frequency [Hz], base motions (eras,) [m]."""
        table, tips = self.table, read_fingertips(self.table, self.places)
        k, p, r = tips.fine.shape
        loads = fingertip_loads(table.fingertip, self.places, self.loads)
        centres = tips.fine[: len(loads), 0].astype(float)
        fingers = [(at, load.fingertip) for at, load in zip(centres, loads, strict=True)]
        squares = np.zeros(())
        for frequency, bases in tones:
            found = enveloped_accelerations(
                table.in_time,
                bases,
                float(frequency),
                points=tips.fine.reshape(-1, r).astype(float),
                fingers=fingers,
                envelope=self.envelope.values,
                step=self.envelope.step,
            )
            threshold = detection_threshold(np.array(frequency), table.threshold)
            squares = squares + (found.real**2 + found.imag**2) / threshold**2
        return self.envelope.felt(squares.reshape(-1, k, p), tips.fine_weights.astype(float))


def on_drawn_plates(
    energies: FloatArray, heard: FloatArray, factor: FloatArray | float
) -> FloatArray:
    """Convert energies to power over a duration on drawn plates (..., 1 + d), nominal first.

    heard (...): power over the duration on the nominal plate; factor: ratio of power to energy at
    the target, applied to the additional energy on other plates.
    """
    added = factor * (energies - energies[..., :1])
    return np.asarray(np.maximum(heard[..., None] + added, 0.0))


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
    ways: Sequence[Sequence[int]] = (),
) -> Tones:
    """Compute the sensation of tones at rows (m,) with weights (m, n).

    owners (m,): the content of each tone; gains (m,): None for the gains that give the contents'
    levels; ringing: per content, None for continuous or shaped ones; ways: as in `with_tones`.
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
    if ways:
        contents, shares = contents.of_first(len(ways)), shares[: len(ways)]
        power, harmonics = (
            np.stack([each[:, [*way]].mean(axis=1) for way in ways], axis=1)
            for each in (power, harmonics)
        )
        for tone, owner in enumerate(owners.tolist()):
            own = [*contents.streams[owner].targets]
            others, of_own = np.setdiff1d(range(len(ways)), own), power[tone, own]
            power[tone, others] += SIDE_BANDS / weights.shape[1] * of_own.mean(axis=(0, 1))
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


def with_tones(
    table: LocalizationTable,
    found: Answer,
    rows: IntArray,
    weights: Sequence[Sequence[complex]],
    owners: IntArray,
    gains: FloatArray | None,
    ways: Sequence[Sequence[int]] = (),
) -> Answer:
    """Return the answer with other tones, and the resulting promises.

    gains: of the tones, None for the gains that give the contents' levels. ways: fingers, by
    number, that are points on the path of each of the first fingers; each of these feels the mean
    power there.
    """
    contents = found.contents
    fingers = FingersOnPlate.of(table, contents.places, contents.loads)
    of_tones = rows, np.array(weights, dtype=np.complex64), owners
    ringing = RingingUnderFingers.of_streams(table, contents)
    tones = promised(fingers, contents, *of_tones, gains=gains, ringing=ringing, ways=ways)
    factor = tones.stroke_factor if gains is None else found.stroke_factor
    return replace(found, tones=replace(tones, stroke_factor=factor))


def _compared(
    contents: Contents,
    power: Float32Array,
    harmonics: Float32Array,
    shares: Float32Array,
    rows: IntArray,
    owners: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return level (k, 2), contrast (k, 3), foreign level (k,), and the worst promise.

    As amplitude ratios, for one threshold set, to which power (m, k, p, d) and that of harmonics
    (m, k, d) are relative. NaN if there is nothing to compare.
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
        contrast[[*streams[0].targets]] = worst  # contrast at the loudest quiet finger
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
    """Return power (m, k, p, d) over the contents' durations, and that of harmonics (m, k, d).

    From the energy of the tones in the drives' spectra, on each plate.
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
    """Return gains (K,) that give contents their levels on 90 % of plates; see `share_stroke`.

    A short stimulus reaches its level on the nominal plate. It is raised only while others feel at
    most half of it, or nothing.
    """
    streams, levels = contents.streams, contents.levels.astype(float)
    alone = np.arange(len(owners))  # as if all frequencies were different
    imperceptible = 10 ** (IMPERCEPTIBLE_DB_SL / 20)
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
            highest = max(levels[j] * 10 ** (-MIN_RAISED_CONTRAST_DB / 20), imperceptible)
            allowed = highest * contrast / max(float(felt[0]), 1e-30)
            gains[j] = min(gains[j], max(allowed, levels[j] / max(promise(lasting), 1e-30)))
    drives = np.zeros((len(streams), weights.shape[1]))
    np.add.at(drives, owners, np.abs(weights))
    priorities = [stream.priority for stream in streams]
    return share_stroke(gains, drives, levels, priorities)


def share_stroke(
    gains: FloatArray,
    weights: Complex64Array | FloatArray,
    levels: FloatArray,
    priorities: Sequence[int],
) -> tuple[FloatArray, float]:
    """Lower gains (K,) to levels (K,) until they fit the stroke; also return the smallest factor.

    Among contents of equal priority, the louder ones are lowered first to a common level (max-min
    fairness), until all fit into what higher priorities leave.
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
    """Return the lowest amplitude of a content's own tones at its targets, (d,).

    power (m, k, p, d): of all tones; shares (k, p): weights of the points in the mean over a
    fingertip. Tones of other contents at the same row (m,) can cancel part of it.
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
    """Return the power (d,) of j tones at the loudest point of a finger.

    power (j, k, p, d): amplitudes of tones at the same row (j,) add; harmonics (j, k, d): power of
    second harmonics over each fingertip, at any phase.
    """
    at = power[:, finger]
    total = np.zeros(at.shape[1:], dtype=at.dtype)
    order = np.argsort(rows, kind="stable").tolist()
    for _, same in groupby(order, key=rows.__getitem__):
        total += np.sqrt(at[list(same)]).sum(axis=0) ** 2
    return np.asarray(total.max(axis=0) + harmonics[:, finger].sum(axis=0))


def promise(values: Float32Array, percent: float = PROMISED_PERCENTILE) -> float:
    """Return a percentile over the drawn plates of values (1 + d,), the first value being
    nominal."""
    return float(percentile(values[1:].astype(float), percent))


def figures(ratio: Float32Array) -> tuple[float, float, float]:
    """Return the nominal value, the median of the drawn plates and the promise of ratios (1 +
    d,)."""
    return float(ratio[0]), promise(ratio, 50), promise(ratio)
