"""Excursions of exciter magnets, and the limits on drives that keep them within range.

An onset moves a magnet further than the settled vibration: free vibration near its own resonance
beats with the drive. A drive that rises or falls steadily, along whatever ramp, is a mean of drives
that jump at different times, so it moves a magnet no further than a drive that jumps; shares of
full level are computed for that (`MagnetMotions`). Levels that come and go are followed step by
step (`Swing`): at the rate of the beat, 10 to 60 times a second, they pump the magnets' free
vibration, since a side band is at their resonance. The eigenvectors near the drive are followed
exactly, for straight lines between steps; those far above follow the level at once. Shaped
envelopes rise above their final amplitude; their difference from a plain ramp is scaled to what the
magnets allow.

All of this holds for the nominal board. The additional motion on boards within the rig's tolerances
is estimated from a few drawn boards, per frequency, so that 90 % stay within range.

`reach_of` finds the frequency above which a rig reaches a level over its whole plate. At each
position (mean over a resting finger) all actuators add in phase, at full level, or at the fraction
that the rig's limits and the magnets' excursion allow.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.arrays import ComplexArray, FloatArray, lattice
from model.errors import InputError
from model.finger import FIVE_POINTS, STRONG_DB_SL, decibels, detection_threshold, fingertips_on
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_summary import exciters_of
from model.structure.attachments import PointLoad, footprints_of
from model.transients.base_motion import KNOT_STEP, rise
from model.transients.knots import RISE, SAMPLES
from model.transients.time_response import PlateInTime, plate_in_time

DECAYED = 0.25
"""Time [s] after which little is left of the magnets' free vibration."""

CLICKS_APART = 0.060
"""Least time [s] between the starts of clicks, at one finger or several; closer ones merge."""

_SWING_STEP = 0.002  # s; between samples: the beat with a magnet's own vibration takes 5 ms or more
_PACES = 0.060  # s; from the shortest to the longest pause between repetitions
_NEAR, _BESIDE = 1.5, 50.0  # near eigenvectors are below this multiple of a drive's, plus this [Hz]


@dataclass(frozen=True, eq=False)
class Excursions:
    """Excursions of each exciter at the rig's level [m], (n,).

    - at_lowest: settled at its lowest frequency.
    - largest: in onsets within all its limits, for exciters with a limit.
    - passed (n,): whether these exceed the limits.
    - allowed: lowest frequency [Hz] above which all stay within the limits up to the highest,
      infinite if there is none.
    """

    at_lowest: FloatArray
    largest: FloatArray
    passed: NDArray[np.bool_]
    allowed: float


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
    settled = plate.following(np.array([s]))[0][0].T[:, :, None] * rows.T[:, None, :]
    near = np.abs(plate.eigenvalues) < 2 * math.pi * (_NEAR * frequency + _BESIDE)
    parts = math.ceil(swing.step / _SWING_STEP)
    step, knots = swing.step / parts, len(swing.shares)
    level = np.interp(np.arange(parts * (knots - 1) + 1) / parts, np.arange(knots), swing.shares)
    rates: ComplexArray = plate.eigenvalues[near] - s
    decays = np.exp(rates * step)
    ends = 1 - (decays - 1) / (rates * step)
    added = level[1:, None] * ends + level[:-1, None] * (1 - decays - ends)
    follows = np.zeros((len(level), len(rates)), dtype=complex)
    for number, each in enumerate(added, 1):
        follows[number] = decays * follows[number - 1] + each
    moved = np.tensordot(follows, settled[near], axes=1)
    moved += level[:, None, None] * settled[~near].sum(axis=0)
    largest = np.abs(moved).sum(axis=1).max(axis=0)
    if swing.again < math.inf:  # phases continue from one to the next
        for pause in np.arange(swing.again, swing.again + _PACES, _SWING_STEP):
            count = math.ceil(pause / step)
            spare = np.pad(moved, ((0, -len(moved) % count), (0, 0), (0, 0)))
            anew = np.abs(spare.reshape(-1, count, *moved.shape[1:]).sum(axis=0))
            largest = np.maximum(largest, anew.sum(axis=1).max(axis=0))
    return np.asarray(largest)


BOARDS, _SEED = 12, 4
"""Number of drawn boards, and their seed."""

_NINE_OF_TEN = 1.28  # standard deviations for 90 %
_SOFTEST = 0.1  # times the stiffness of the file
_FAR_WITHIN = 1 / 3  # of the excursion

_JUMP_STEP = 0.0005  # s; between samples after a jump
_AFTER = 20  # steps that are followed after the last knot
_KEPT, _SWINGS_KEPT = 16, 256  # sizes of caches
_CHECKED = 1.0  # Hz; between frequencies of a rig that are checked


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
        limits = np.array([each.excursion for each in plate.eras])
        some = np.isfinite(limits)
        drawn = _drawn(plate, uncertainty, loads) if uncertainty and some.any() else ()
        rows = plate.stretches[some] @ plate.displacement
        return cls(plate, rows, limits[some], tuple(cls.of(each) for each in drawn))

    def allowed(self, *frequencies: float) -> FloatArray:
        """Return motions (f, m) [m] on the nominal board that keep 90 % of boards within the
        limits."""
        return self.excursions / _further(self, frequencies)[:, None]

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
        found = []
        for frequency in frequencies.tolist():
            s = 2j * math.pi * frequency
            z = self.plate.following(np.array([s]))[0][0]
            by_mode = (z.T[:, :, None] * self.rows.T[:, None, :]).reshape(z.shape[1], -1)
            settled = by_mode.sum(axis=0)
            free = np.exp(-s * times)[:, None] * (decays @ by_mode)
            moved = np.abs(settled - free).reshape(len(times), -1, len(self.rows))
            steady = np.abs(settled).reshape(-1, len(self.rows)).sum(axis=0)
            found.append(np.maximum(moved.sum(axis=1).max(axis=0), steady))
        return np.array(found)

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
        times = KNOT_STEP * np.arange(len(knots), dtype=float)
        plain = first + rise(times, min(RISE, times[-1]))[:, None] * (last - first)
        (allowed,) = part * self.allowed(frequency)
        moved, least = (self.largest(frequency, each) for each in (knots, plain))
        if (moved <= allowed).all():
            return knots
        spare = np.maximum(allowed - least, 0) / np.maximum(moved - least, 1e-30)
        kept = float(np.where(moved > allowed, spare, 1.0).min())
        return np.asarray(plain + kept * (knots - plain))

    def largest(self, frequency: float, knots: ComplexArray) -> FloatArray:
        """Largest motions (m,) [m] along an envelope (n, eras) at a frequency [Hz], in any phase.

        Until time 0 the drives are steady at the first knot.
        """
        ramps, settled = _ramps_of(self, frequency)
        count = (len(knots) + _AFTER) * SAMPLES
        moved = np.repeat((knots[0] @ settled)[None], count, axis=0)
        slopes = np.diff(knots, axis=0, prepend=knots[:1], append=knots[-1:])
        for number, change in enumerate(np.diff(slopes, axis=0)):
            since = number * SAMPLES
            moved[since:] += np.tensordot(ramps[: count - since], change, axes=(1, 0))
        return np.asarray(np.abs(moved).max(axis=0))


@lru_cache(_SWINGS_KEPT)  # the same answer is computed several times
def share_along(magnets: MagnetMotions, frequency: float, swing: Swing) -> float:
    """Share of full level, 1 at most, at which a level may swing at a frequency [Hz]."""
    moved = motions_along(magnets.plate, magnets.rows, frequency, swing)
    return min(1.0, float((magnets.allowed(frequency) / moved).min()))


@lru_cache(_SWINGS_KEPT)
def _further(magnets: MagnetMotions, frequencies: tuple[float, ...]) -> FloatArray:
    """Return the factor by which magnets move further on 90 % of boards (f,), at least 1.

    1 if jumps to full level are far within the excursion.
    """
    at, found = np.array(frequencies), np.ones(len(frequencies))
    own = (magnets.by_jumps(at) / magnets.excursions).max(axis=1)
    is_near = (own > _FAR_WITHIN) & bool(magnets.boards)
    if is_near.any():
        moved = [(each.by_jumps(at[is_near]) / each.excursions) for each in magnets.boards]
        ratios = np.log(np.array(moved).max(axis=2) / own[is_near])
        last = ratios.mean(axis=0) + _NINE_OF_TEN * ratios.std(axis=0)
        found[is_near] = np.exp(np.maximum(last, 0.0))
    return found


def _drawn(
    plate: PlateInTime, known: Uncertainty, loads: Sequence[PointLoad]
) -> Iterator[PlateInTime]:
    """Yield boards within the uncertainty of a plate with loads, BOARDS at most."""
    n, of = len(plate.eras), plate.reduced
    numbers = np.random.default_rng(_SEED).standard_normal((BOARDS, 3 + 2 * n + len(loads)))
    numbers = (numbers - numbers.mean(axis=0)) / numbers.std(axis=0)
    for drawn in numbers:
        (q, loss, damping), own, gain, feet = np.split(drawn, [3, 3 + n, 3 + 2 * n])
        springs = np.maximum(1 + known.stiffness * own, _SOFTEST)
        softer = np.exp(known.supports * feet)
        board = replace(
            of,
            plate=replace(of.plate, loss_factor=of.plate.loss_factor * known.damping**loss),
            omega=of.omega * (1 + known.frequency * q),
        )
        eras = [
            era.varied(stiffness=by, damping=known.damping**damping)
            for era, by in zip(plate.eras, springs.tolist(), strict=True)
        ]
        resting = [
            replace(load, stiffness=by * load.stiffness) if load.is_foot else load
            for load, by in zip(loads, softer.tolist(), strict=True)
        ]
        with suppress(InputError):  # nothing holds it
            found = plate_in_time(board, eras, loads=resting)
            driven = found.participation * (1 + known.gain * gain)
            yield replace(found, participation=driven)


@lru_cache(_KEPT)
def _ramps_of(magnets: MagnetMotions, frequency: float) -> tuple[ComplexArray, ComplexArray]:
    """Return motions (t, eras, m) by levels that rise by one per step, and settled ones (eras, m).

    Long enough for every onset.
    """
    plate, s = magnets.plate, 2j * math.pi * frequency
    steady, slope = (each[0] for each in plate.following(np.array([s])))
    a0, a1 = slope / KNOT_STEP, steady / KNOT_STEP
    times = KNOT_STEP / SAMPLES * np.arange(64 * SAMPLES)
    decay = np.exp(np.outer(times, plate.eigenvalues - s))
    free = np.stack([(decay * row) @ magnets.rows.T for row in a0], axis=1)
    ramps = a0 @ magnets.rows.T + times[:, None, None] * (a1 @ magnets.rows.T) - free
    return np.asarray(ramps), np.asarray(steady @ magnets.rows.T)


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
    exciters, omega = exciters_of(rig), 2 * np.pi * frequencies
    places = np.array([[one.x, one.y] for one in exciters])
    fields = free.acceleration(rig.eras, frequencies, places, loads=rig.masses)
    moved = fields / -(omega**2)[:, None, None]
    for number, one in enumerate(exciters):
        moved[:, rig.eras.index(one), number] -= one.base(omega)
        moved[:, :, number] = one.excursion_by(omega, moved[:, :, number])
    return moved


def excursions_of(rig: Rig, free: FreePlate | None = None) -> Excursions:
    """Compute the excursions at the rig's frequencies and level; free: its plate, if solved."""
    limits, exciters = rig.limits, exciters_of(rig)
    low, high = limits.frequency_min, limits.frequency_max
    frequencies = np.append(np.arange(low, high, _CHECKED), high)
    free = free or solve_free_plate(rig.plate, rig.mesh, frequency_max=high)
    settled = np.abs(relative_motions(rig, free, frequencies[:1])).sum(axis=1)[0]
    largest = np.zeros((len(frequencies), len(exciters)))
    some = [number for number, one in enumerate(exciters) if math.isfinite(one.excursion)]
    if some:
        magnets = magnets_of(rig, free)
        further = magnets.excursions / magnets.allowed(*frequencies.tolist())
        largest[:, some] = limits.level * further * magnets.by_jumps(frequencies)
    passed = largest > np.array([one.excursion for one in exciters])
    rows = np.flatnonzero(passed.any(axis=1))
    allowed = low
    if len(rows):
        allowed = float(frequencies[rows[-1] + 1]) if rows[-1] + 1 < len(passed) else math.inf
    return Excursions(
        limits.level * settled, largest.max(axis=0), np.asarray(passed.any(axis=0)), allowed
    )


_MARGIN = 0.02
"""Width of the strip along the edges [m] that is left out."""

UP_TO, _STEP = 300.0, 10.0
"""Highest frequency of a reach, and the step of frequencies [Hz]."""

_SPACING = 0.012  # m
_AT_ONCE = 40  # places


@dataclass(frozen=True, eq=False)
class Reach:
    """Levels that a rig reaches over its plate."""

    frequencies: FloatArray
    """Frequencies (f,) [Hz]."""
    least_db_sl: FloatArray
    """Least level over the plate (f,)."""
    shares: FloatArray
    """Share (f,) of the places that reach STRONG_DB_SL."""

    @property
    def start(self) -> float | None:
        """Lowest frequency [Hz] above which all positions reach the level, None without one."""
        whole = self.frequencies[self.shares == 1]
        return float(whole[0]) if len(whole) else None

    def as_json(self) -> dict[str, Any]:
        """Return the reach for programs."""
        return {
            "level_db_sl": STRONG_DB_SL,
            "from_hz": self.start,
            "frequencies_hz": self.frequencies.tolist(),
            "least_level_db_sl": self.least_db_sl.round(2).tolist(),
            "share_of_places": self.shares.round(4).tolist(),
        }


def reach_of(rig: Rig, free: FreePlate) -> Reach:
    """Compute the reach of a rig within its limits, up to UP_TO; free: the rig's plate."""
    plate, limits = rig.plate, rig.limits
    low = limits.frequency_min
    frequencies = np.arange(low, min(limits.frequency_max, max(UP_TO, low)) + 1e-9, _STEP)
    margins = [(side, min(_MARGIN, side / 4)) for side in (plate.length, plate.width)]
    places = lattice(
        *(
            np.linspace(edge, side - edge, 1 + math.ceil((side - 2 * edge) / _SPACING))
            for side, edge in margins
        )
    )
    level = np.minimum(magnets_of(rig, free).shares(frequencies), limits.level)[:, None]
    threshold = detection_threshold(frequencies, rig.threshold)[:, None]
    found = []
    for few in np.array_split(places, math.ceil(len(places) / _AT_ONCE)):
        points, weights = fingertips_on(
            few, length=plate.length, width=plate.width, rule=FIVE_POINTS
        )
        fields = free.acceleration(
            rig.eras, frequencies, points.reshape(-1, 2), loads=rig.masses
        ).reshape(len(frequencies), len(rig.eras), *weights.shape)
        phases = fields[..., 0].conj() / np.abs(fields[..., 0])
        together = np.abs((fields * phases[..., None]).sum(axis=1))
        felt = level * (together * weights).sum(axis=-1)
        found.append(felt / _held(rig, free, few, frequencies) / threshold)
    levels = decibels(np.concatenate(found, axis=1))
    return Reach(frequencies, levels.min(axis=1), (levels >= STRONG_DB_SL).mean(axis=1))


def _held(rig: Rig, free: FreePlate, places: FloatArray, frequencies: FloatArray) -> FloatArray:
    """Return the factor (f, p) by which a finger reduces the motion at its position, 1 + D R."""
    if rig.fingertip is None:
        return np.ones((len(frequencies), len(places)))
    attached = (*rig.eras, *rig.masses)
    between, _ = free.receptances(places, places[:1], frequencies, loads=attached)
    stiffness = rig.fingertip.dynamic_stiffness(2 * np.pi * frequencies)
    own = np.diagonal(between, axis1=-2, axis2=-1)
    return np.abs(1 + stiffness[:, None] * own)


def excursion_notes(rig: Rig) -> Iterator[str]:
    """Yield a warning where full level would move magnets beyond their excursion."""
    exciters, limits = exciters_of(rig), rig.limits
    found = excursions_of(rig) if exciters else None
    if found is None or not found.passed.any():
        return
    shares = found.largest / [one.excursion for one in exciters]
    worst = int(shares.argmax())
    names = [one.name for one, is_far in zip(exciters, found.passed, strict=True) if is_far]
    lowest = (
        f"within from {found.allowed:g} Hz on" if np.isfinite(found.allowed) else "nowhere within"
    )
    yield (
        f"limits.frequency: from {limits.frequency_min:g} Hz on limits.level {limits.level:g} can "
        f"move the magnets of {', '.join(names)} beyond their excursion ("
        f"{exciters[worst].name} to {1e3 * found.largest[worst]:.2g} mm of "
        f"{1e3 * exciters[worst].excursion:.2g} mm; {lowest}). Answers play less there, manual "
        "tones do not: a level of at most "
        f"{math.floor(1e3 * limits.level / shares[worst]) / 1e3:g} is safe"
    )
