"""Excursions of exciter magnets, and the limits on drives that keep them within range.

An onset moves a magnet further than the settled vibration: free vibration near its own resonance
beats with the drive. A drive that rises or falls monotonically is a mean of drives that jump at
different times, so it moves a magnet no further than a drive that jumps. Shares of full level are
computed for a jump (`MagnetMotions`). Repeated changes of level are simulated step by step
(`Swing`): at the rate of the beat, 10 to 60 times a second, they pump the magnets' free vibration,
because a side band is at their resonance. The eigenvectors near the drive are solved exactly, for
straight lines between steps; eigenvectors at much higher frequencies follow the level immediately.
Shaped envelopes rise above their final amplitude; their difference from a plain ramp is scaled to
the magnets' limits.

All of this holds for the nominal board. The additional motion on boards within the rig's tolerances
is estimated from a few drawn boards, per frequency, so that 90 % stay within range.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_summary import exciters_of
from model.structure.attachments import PointLoad, footprints_of
from model.structure.sources import Source
from model.transients.base_motion import KNOT_STEP, rise
from model.transients.knots import RISE, SAMPLES
from model.transients.plate_in_time import PlateInTime, plate_in_time

DECAYED = 0.25
"""Time [s] after which little is left of the magnets' free vibration."""

CLICKS_APART = 0.060
"""Least time [s] between the starts of clicks, at one finger or several; closer ones merge."""

BOARDS, _SEED = 12, 4
"""Number of drawn boards, and their seed."""

_SIGMAS_OF_90_PERCENT = 1.28
_SOFTEST = 0.1  # times the stiffness of the file
_FAR_WITHIN = 1 / 3  # of the excursion

_JUMP_STEP = 0.0005  # s; between samples after a jump
_STEPS_AFTER = 20  # followed after the last knot
_RAMP_STEPS = 64  # longer than every onset
_KEPT, _SWINGS_KEPT = 16, 256  # sizes of caches
_CHECKED = 1.0  # Hz; between frequencies of a rig that are checked
_TINY = 1e-30

_SWING_STEP = 0.002  # s; between samples: the beat with a magnet's own vibration takes 5 ms or more
_PACES = 0.060  # s; from the shortest to the longest pause between repetitions

_NEAR, _NEAR_OFFSET = 1.5, 50.0
"""Near eigenvectors are below this multiple of a drive's frequency, plus this offset [Hz]."""


@dataclass(frozen=True, eq=False)
class Excursions:
    """Excursions of n exciters at the rig's level."""

    at_lowest: FloatArray
    """Settled excursion (n,) at the rig's lowest frequency [m]."""
    largest: FloatArray
    """Largest excursion (n,) in onsets within all limits [m]; 0 for exciters without a limit."""
    passed: NDArray[np.bool_]
    """Whether these exceed the exciters' limits (n,)."""
    allowed: float
    """Lowest frequency [Hz] from which on all magnets stay within their limits; infinite without
    such a frequency."""


@dataclass(frozen=True)
class Swing:
    """A level that varies over time, linear between steps."""

    shares: tuple[float, ...]
    """Shares of full level at each step, the first 0."""
    step: float
    """Time between shares [s]."""
    again: float = math.inf
    """Time [s] after which it may start again while the plate still rings, infinite for never."""


def motions_along(
    plate: "PlateInTime", rows: ComplexArray, frequency: float, swing: Swing
) -> FloatArray:
    """Return the largest motions (m,) [m] by drives at a frequency [Hz] along a swing, from rest.

    rows (m, 2 r): motion of each magnet in each eigenvector. For all drives at full level together,
    in the phases in which their motions add, and at the worst pace of repetition.
    """
    s = 2j * math.pi * frequency
    settled = _settled_by_mode(plate, rows, s)
    is_near = np.abs(plate.eigenvalues) < 2 * math.pi * (_NEAR * frequency + _NEAR_OFFSET)
    level, step = _resampled(swing)
    followed = _followed_level(plate.eigenvalues[is_near] - s, level, step)
    moved = np.tensordot(followed, settled[is_near], axes=1)
    moved += level[:, None, None] * settled[~is_near].sum(axis=0)
    largest = np.abs(moved).sum(axis=1).max(axis=0)
    if swing.again < math.inf:  # phases continue from one repetition to the next
        for pause in np.arange(swing.again, swing.again + _PACES, _SWING_STEP):
            count = math.ceil(pause / step)
            whole_periods = np.pad(moved, ((0, -len(moved) % count), (0, 0), (0, 0)))
            by_period = whole_periods.reshape(-1, count, *moved.shape[1:])
            repeated = np.abs(by_period.sum(axis=0))
            largest = np.maximum(largest, repeated.sum(axis=1).max(axis=0))
    return np.asarray(largest)


def _settled_by_mode(plate: PlateInTime, rows: ComplexArray, s: complex) -> ComplexArray:
    """Return the settled motion (2 r, eras, m) of magnets in each eigenvector, by each ERA.

    At full level and at s = i omega [1/s]; rows (m, 2 r): motion of each magnet in the
    eigenvectors.
    """
    by_era, _ = plate.following(np.array([s]))
    return np.asarray(by_era[0].T[:, :, None] * rows.T[:, None, :])


def _resampled(swing: Swing) -> tuple[FloatArray, float]:
    """Return the level (t,) of a swing at steps of at most _SWING_STEP, and the step [s]."""
    parts = math.ceil(swing.step / _SWING_STEP)
    knot_count = len(swing.shares)
    positions = np.arange(parts * (knot_count - 1) + 1) / parts
    level = np.interp(positions, np.arange(knot_count), swing.shares)
    return level, swing.step / parts


def _followed_level(rates: ComplexArray, level: FloatArray, step: float) -> ComplexArray:
    """Return how far each eigenvector follows a level (t,), linear between steps [s]: (t, n).

    rates (n,) [1/s]: eigenvalues relative to the drive. 1 once an eigenvector has settled at 1.
    """
    decays = np.exp(rates * step)
    end_shares = 1 - (decays - 1) / (rates * step)
    start_shares = 1 - decays - end_shares
    added = level[1:, None] * end_shares + level[:-1, None] * start_shares
    followed = np.zeros((len(level), len(rates)), dtype=complex)
    for number, change in enumerate(added, 1):
        followed[number] = decays * followed[number - 1] + change
    return followed


@dataclass(frozen=True, eq=False)
class MagnetMotions:
    """Motions of the m magnets of limited excursion against their coils."""

    plate: PlateInTime
    rows: ComplexArray
    """Displacement (m, 2 r) of the coil in the magnet, in each eigenvector."""
    excursions: FloatArray
    """Excursion (m,) of each magnet [m]."""
    boards: tuple["MagnetMotions", ...] = ()
    """The same of boards within the uncertainty; none of a board that is known."""

    @classmethod
    def of(
        cls,
        plate: PlateInTime,
        uncertainty: Uncertainty | None = None,
        loads: Sequence[PointLoad] = (),
    ) -> "MagnetMotions":
        """Make the motions of a plate's magnets; empty if no source is limited.

        uncertainty: of the plate with its loads, None if it is exactly known.
        """
        limits = np.array([era.excursion for era in plate.eras])
        is_limited = np.isfinite(limits)
        boards = list[MagnetMotions]()
        if uncertainty and is_limited.any():
            boards = [cls.of(board) for board in _drawn_boards(plate, uncertainty, loads)]
        return cls(
            plate=plate,
            rows=plate.stretches[is_limited] @ plate.displacement,
            excursions=limits[is_limited],
            boards=tuple(boards),
        )

    def allowed(self, *frequencies: float) -> FloatArray:
        """Return motions (f, m) [m] on the nominal board that keep 90 % of boards within the
        limits."""
        return self.excursions / _board_factors(self, frequencies)[:, None]

    def shares(self, frequencies: FloatArray) -> FloatArray:
        """Share (f,) of full level, 1 at most, to which all may jump at frequencies [Hz]."""
        if not len(self.rows):
            return np.ones(len(frequencies))
        allowed = self.allowed(*frequencies.tolist())
        least: FloatArray = (allowed / self.by_jumps(frequencies)).min(axis=1)
        return np.minimum(least, 1.0)

    def by_jumps(self, frequencies: FloatArray) -> FloatArray:
        """Largest motions (f, m) [m] by drives that jump to full level at frequencies [Hz].

        For all drives together, in the phases in which their motions add; without fingers.
        """
        times = np.arange(0, DECAYED, _JUMP_STEP)
        decays = np.exp(np.outer(times, self.plate.eigenvalues))
        magnet_count = len(self.rows)
        largest = list[FloatArray]()
        for frequency in frequencies.tolist():
            s = 2j * math.pi * frequency
            by_mode = _settled_by_mode(self.plate, self.rows, s).reshape(decays.shape[1], -1)
            settled = by_mode.sum(axis=0)
            free = np.exp(-s * times)[:, None] * (decays @ by_mode)
            moved = np.abs(settled - free).reshape(len(times), -1, magnet_count)
            steady = np.abs(settled).reshape(-1, magnet_count).sum(axis=0)
            largest.append(np.maximum(moved.sum(axis=1).max(axis=0), steady))
        return np.array(largest)

    def within(self, frequency: float, knots: ComplexArray, *, full: float) -> ComplexArray:
        """Bring an envelope (n, eras) in full levels closer to a plain ramp, as far as necessary.

        Its first and last knots are steady amplitudes. full: share of full level to which drives
        may jump. Each magnet may use the part of its excursion that the steady amplitudes have of
        that share, so that the motions of several contents may add.
        """
        if not len(self.rows):
            return knots
        first, last = knots[0], knots[-1]
        part = max(np.abs(first).max(), np.abs(last).max()) / full
        (allowed,) = part * self.allowed(frequency)
        moved = self.largest(frequency, knots)
        if (moved <= allowed).all():
            return knots
        times = KNOT_STEP * np.arange(len(knots), dtype=float)
        plain = first + rise(times, min(RISE, times[-1]))[:, None] * (last - first)
        moved_by_plain = self.largest(frequency, plain)
        spare = np.maximum(allowed - moved_by_plain, 0) / np.maximum(moved - moved_by_plain, _TINY)
        kept = float(np.where(moved > allowed, spare, 1.0).min())
        return np.asarray(plain + kept * (knots - plain))

    def largest(self, frequency: float, knots: ComplexArray) -> FloatArray:
        """Largest motions (m,) [m] along an envelope (n, eras) at a frequency [Hz], in any phase.

        Until time 0 the drives are steady at the first knot.
        """
        ramps, settled = _ramps_of(self, frequency)
        count = (len(knots) + _STEPS_AFTER) * SAMPLES
        moved = np.repeat((knots[0] @ settled)[None], count, axis=0)
        slopes = np.diff(knots, axis=0, prepend=knots[:1], append=knots[-1:])
        for knot, change_of_slope in enumerate(np.diff(slopes, axis=0)):
            start = knot * SAMPLES
            moved[start:] += np.tensordot(ramps[: count - start], change_of_slope, axes=(1, 0))
        return np.asarray(np.abs(moved).max(axis=0))


@lru_cache(_SWINGS_KEPT)  # the same answer is computed several times
def share_along(magnets: MagnetMotions, frequency: float, swing: Swing) -> float:
    """Share of full level, 1 at most, at which a level may swing at a frequency [Hz]."""
    moved = motions_along(magnets.plate, magnets.rows, frequency, swing)
    return min(1.0, float((magnets.allowed(frequency) / moved).min()))


@lru_cache(_SWINGS_KEPT)
def _board_factors(magnets: MagnetMotions, frequencies: tuple[float, ...]) -> FloatArray:
    """Return factors (f,) on the motion of magnets that 90 % of boards do not exceed, at least 1.

    1 if jumps to full level are far within the excursion.
    """
    factors = np.ones(len(frequencies))
    hertz = np.array(frequencies)
    nominal = (magnets.by_jumps(hertz) / magnets.excursions).max(axis=1)
    is_near = (nominal > _FAR_WITHIN) & bool(magnets.boards)
    if is_near.any():
        moved = list[FloatArray]()
        for board in magnets.boards:
            moved.append((board.by_jumps(hertz[is_near]) / board.excursions).max(axis=1))
        ratios = np.log(np.array(moved) / nominal[is_near])
        last = ratios.mean(axis=0) + _SIGMAS_OF_90_PERCENT * ratios.std(axis=0)
        factors[is_near] = np.exp(np.maximum(last, 0.0))
    return factors


def _drawn_boards(
    plate: PlateInTime, uncertainty: Uncertainty, loads: Sequence[PointLoad]
) -> Iterator[PlateInTime]:
    """Yield boards within the uncertainty of a plate with loads, BOARDS at most."""
    era_count = len(plate.eras)
    rng = np.random.default_rng(_SEED)
    numbers = rng.standard_normal((BOARDS, 3 + 2 * era_count + len(loads)))
    numbers = (numbers - numbers.mean(axis=0)) / numbers.std(axis=0)
    for drawn in numbers:
        with suppress(InputError):  # nothing holds it
            yield _board(plate, uncertainty, loads, drawn)


def _board(
    plate: PlateInTime,
    uncertainty: Uncertainty,
    loads: Sequence[PointLoad],
    numbers: FloatArray,
) -> PlateInTime:
    """Return a board that differs from a plate by standard normal numbers (3 + 2 n + loads,)."""
    nominal = plate.reduced
    n = len(plate.eras)
    (q, loss, damping), springs, gains, feet = np.split(numbers, [3, 3 + n, 3 + 2 * n])
    loss_factor = nominal.plate.loss_factor * uncertainty.damping**loss
    reduced = replace(
        nominal,
        plate=replace(nominal.plate, loss_factor=loss_factor),
        omega=nominal.omega * (1 + uncertainty.frequency * q),
    )
    eras = list[Source]()
    stiffness_factors = np.maximum(1 + uncertainty.stiffness * springs, _SOFTEST)
    for era, factor in zip(plate.eras, stiffness_factors.tolist(), strict=True):
        eras.append(era.varied(stiffness=factor, damping=uncertainty.damping**damping))
    varied_loads = list[PointLoad]()
    foot_factors = np.exp(uncertainty.supports * feet)
    for load, factor in zip(loads, foot_factors.tolist(), strict=True):
        if load.is_foot:
            varied_loads.append(replace(load, stiffness=factor * load.stiffness))
        else:
            varied_loads.append(load)
    board = plate_in_time(reduced, eras, loads=varied_loads)
    participation = board.participation * (1 + uncertainty.gain * gains)
    return replace(board, participation=participation)


@lru_cache(_KEPT)
def _ramps_of(magnets: MagnetMotions, frequency: float) -> tuple[ComplexArray, ComplexArray]:
    """Return motions (t, eras, m) by levels that rise by one per step, and settled ones (eras, m).

    Long enough for every onset.
    """
    plate = magnets.plate
    to_magnets = magnets.rows.T
    s = 2j * math.pi * frequency
    responses, by_s = plate.following(np.array([s]))
    steady = responses[0]
    a0 = by_s[0] / KNOT_STEP
    a1 = steady / KNOT_STEP
    times = KNOT_STEP / SAMPLES * np.arange(_RAMP_STEPS * SAMPLES)
    decay = np.exp(np.outer(times, plate.eigenvalues - s))
    free = np.stack([(decay * by_era) @ to_magnets for by_era in a0], axis=1)
    ramps = a0 @ to_magnets + times[:, None, None] * (a1 @ to_magnets) - free
    return np.asarray(ramps), np.asarray(steady @ to_magnets)


def magnets_of(rig: Rig, free: FreePlate) -> MagnetMotions:
    """Make the motions of a rig's magnets; free: the rig's plate."""
    reduced = reduce_free_plate(free, footprints_of(rig.eras, rig.masses))
    plate = plate_in_time(reduced, rig.eras, loads=rig.masses)
    return MagnetMotions.of(plate, rig.uncertainty, rig.masses)


def relative_motions(rig: Rig, free: FreePlate, frequencies: FloatArray) -> ComplexArray:
    """Return the settled motion of each exciter's coil in its magnet, (f, eras, m) [m].

    For each actuator at full level: T (w - y), with the plate's motion w and the base y equivalent
    to the current (`Exciter.base`). free: the rig's plate. Without fingers: they reduce it.
    """
    exciters = exciters_of(rig)
    omega = 2 * np.pi * frequencies
    positions = np.array([[exciter.x, exciter.y] for exciter in exciters])
    fields = free.acceleration(rig.eras, frequencies, positions, loads=rig.masses)
    moved = fields / -(omega**2)[:, None, None]
    for number, exciter in enumerate(exciters):
        moved[:, rig.eras.index(exciter), number] -= exciter.base(omega)
        moved[:, :, number] = exciter.excursion_by(omega, moved[:, :, number])
    return moved


def excursions_of(rig: Rig, free: FreePlate | None = None) -> Excursions:
    """Compute the excursions at the rig's frequencies and level; free: its plate, if solved."""
    limits = rig.limits
    exciters = exciters_of(rig)
    low, high = limits.frequency_min, limits.frequency_max
    frequencies = np.append(np.arange(low, high, _CHECKED), high)
    free = free or solve_free_plate(rig.plate, rig.mesh, frequency_max=high)
    settled = np.abs(relative_motions(rig, free, frequencies[:1])).sum(axis=1)[0]
    largest = np.zeros((len(frequencies), len(exciters)))
    excursions = np.array([exciter.excursion for exciter in exciters])
    is_limited = np.isfinite(excursions)
    if is_limited.any():
        magnets = magnets_of(rig, free)
        board_factors = magnets.excursions / magnets.allowed(*frequencies.tolist())
        by_jumps = magnets.by_jumps(frequencies)
        largest[:, is_limited] = limits.level * board_factors * by_jumps
    passed = largest > excursions
    rows = np.flatnonzero(passed.any(axis=1))
    allowed = low
    if len(rows):
        next_row = rows[-1] + 1
        allowed = float(frequencies[next_row]) if next_row < len(passed) else math.inf
    return Excursions(
        at_lowest=limits.level * settled,
        largest=largest.max(axis=0),
        passed=np.asarray(passed.any(axis=0)),
        allowed=allowed,
    )


def excursion_notes(rig: Rig) -> Iterator[str]:
    """Yield a warning where full level would move magnets beyond their excursion."""
    exciters = exciters_of(rig)
    if not exciters:
        return
    excursions = excursions_of(rig)
    if not excursions.passed.any():
        return
    limits = rig.limits
    shares = excursions.largest / [exciter.excursion for exciter in exciters]
    worst = int(shares.argmax())
    names = [exciters[number].name for number in np.flatnonzero(excursions.passed)]
    lowest = "nowhere within"
    if np.isfinite(excursions.allowed):
        lowest = f"within from {excursions.allowed:g} Hz on"
    yield (
        f"limits.frequency: from {limits.frequency_min:g} Hz on limits.level {limits.level:g} can "
        f"move the magnets of {', '.join(names)} beyond their excursion ("
        f"{exciters[worst].name} to {1e3 * excursions.largest[worst]:.2g} mm of "
        f"{1e3 * exciters[worst].excursion:.2g} mm; {lowest}). Answers play less there, manual "
        "tones do not: a level of at most "
        f"{math.floor(1e3 * limits.level / shares[worst]) / 1e3:g} is safe"
    )
