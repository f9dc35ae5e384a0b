"""How far the magnets of exciters move in time, and what keeps them within their excursion.

An onset moves a magnet further than the settled vibration: the free vibration near its own
resonance beats with the drive. A drive that rises or falls steadily, along whichever ramp, is a
mean of drives that jump at different times; so it moves a magnet no further than the drive that
jumps, with which shares of full level are counted; what comes and goes is followed
(`model.transients.swings`). Shaped envelopes rise above their last
amplitude: of their difference to a plain ramp as much is kept as magnets allow.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from model.arrays import ComplexArray, FloatArray
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.reduction.reduced_plate import reduce_free_plate
from model.rig.rig import Rig
from model.rig.rig_summary import Excursions, exciters_of
from model.structure.attachments import footprints_of
from model.transients.base_motion import KNOT_STEP, rise
from model.transients.knots import RISE, SAMPLES
from model.transients.swings import DECAYED, Swing, motions_along
from model.transients.time_response import PlateInTime, plate_in_time

_STEP = 0.0005  # s
_AFTER = 20  # steps after the last knot
_KEPT, _SWINGS_KEPT = 16, 256
_CHECKED = 1.0  # Hz between frequencies of a rig that are checked


@dataclass(frozen=True, eq=False)
class MagnetMotions:
    """Motions of the m magnets that are limited, against their coils, by drives in full levels.

    rows (m, 2 r): displacement of the coil in the magnet in each eigenvector; excursions (m,) [m].
    """

    plate: PlateInTime
    rows: ComplexArray
    excursions: FloatArray

    @classmethod
    def of(cls, plate: PlateInTime) -> "MagnetMotions":
        """Those of a plate; none where no source is limited."""
        limits = np.array([each.excursion for each in plate.eras])
        some = np.isfinite(limits)
        return cls(plate, plate.stretches[some] @ plate.displacement, limits[some])

    def shares(self, frequencies: FloatArray) -> FloatArray:
        """Share of full level (f,), 1 at most, with which all may jump at frequencies [Hz]."""
        if not len(self.rows):
            return np.ones(len(frequencies))
        least: FloatArray = (self.excursions / self.by_jumps(frequencies)).min(axis=1)
        return np.asarray(np.minimum(least, 1.0))

    def share_along(self, frequency: float, swing: Swing) -> float:
        """Share of full level, 1 at most, that may swing at a frequency [Hz]."""
        return _share_along(self, frequency, swing)

    def by_jumps(self, frequencies: FloatArray) -> FloatArray:
        """Largest motions (f, m) [m] by drives that jump to full level at frequencies [Hz].

        Of all together, in those phases in which the motions by each add; without fingers.
        """
        times = np.arange(0, DECAYED, _STEP)
        decays = np.exp(np.outer(times, self.plate.eigenvalues))
        found = []
        for frequency in frequencies.tolist():
            s = 2j * math.pi * frequency
            by_mode, settled = self._settled(s)
            free = np.exp(-s * times)[:, None] * (decays @ by_mode)
            moved = np.abs(settled - free).reshape(len(times), -1, len(self.rows))
            steady = np.abs(settled).reshape(-1, len(self.rows)).sum(axis=0)
            found.append(np.maximum(moved.sum(axis=1).max(axis=0), steady))
        return np.array(found)

    def within(self, frequency: float, knots: ComplexArray, *, full: float) -> ComplexArray:
        """As much of a shape (n, eras) in full levels, first and last included, as magnets allow.

        full: the share of full level that may jump. Each magnet may move by the part of its
        excursion that the drives' steady amplitudes have of that share, so that those of several
        contents may add.
        """
        if not len(self.rows):
            return knots
        first, last = knots[0], knots[-1]
        part = max(np.abs(first).max(), np.abs(last).max()) / full
        times = KNOT_STEP * np.arange(len(knots), dtype=float)
        plain = first + rise(times, min(RISE, times[-1]))[:, None] * (last - first)
        allowed = part * self.excursions
        moved, least = (self.largest(frequency, each) for each in (knots, plain))
        if (moved <= allowed).all():
            return knots
        spare = np.maximum(allowed - least, 0) / np.maximum(moved - least, 1e-30)
        kept = float(np.where(moved > allowed, spare, 1.0).min())
        return np.asarray(plain + kept * (knots - plain))

    def largest(self, frequency: float, knots: ComplexArray) -> FloatArray:
        """Largest motions (m,) [m] along an envelope (n, eras), steady at its first until time 0.

        At a frequency [Hz], in whichever phase of it.
        """
        ramps, settled = _ramps_of(self, frequency)
        count = (len(knots) + _AFTER) * SAMPLES
        moved = np.repeat((knots[0] @ settled)[None], count, axis=0)
        slopes = np.diff(knots, axis=0, prepend=knots[:1], append=knots[-1:])
        for number, change in enumerate(np.diff(slopes, axis=0)):
            since = number * SAMPLES
            moved[since:] += np.tensordot(ramps[: count - since], change, axes=(1, 0))
        return np.asarray(np.abs(moved).max(axis=0))

    def _settled(self, s: complex) -> tuple[ComplexArray, ComplexArray]:
        """Settled motions by each source, by eigenvector (2 r, eras m), and all in all."""
        z = self.plate.following(np.array([s]))[0][0]
        by_mode = z.T[:, :, None] * self.rows.T[:, None, :]
        flat = by_mode.reshape(len(by_mode), -1)
        return flat, flat.sum(axis=0)


@lru_cache(_SWINGS_KEPT)  # of an answer that is asked for several times
def _share_along(magnets: MagnetMotions, frequency: float, swing: Swing) -> float:
    moved = motions_along(magnets.plate, magnets.rows, frequency, swing)
    return min(1.0, float((magnets.excursions / moved).min()))


@lru_cache(_KEPT)
def _ramps_of(magnets: MagnetMotions, frequency: float) -> tuple[ComplexArray, ComplexArray]:
    """Motions by each at full level per step since time 0, (t, eras, m), and settled ones.

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
    """Those of a rig; free: its plate."""
    reduced = reduce_free_plate(free, footprints_of(rig.eras, rig.masses))
    return MagnetMotions.of(plate_in_time(reduced, rig.eras, loads=rig.masses))


def relative_motions(rig: Rig, free: FreePlate, frequencies: FloatArray) -> ComplexArray:
    """Settled motion of each exciter's coil in its magnet by each actuator, (f, eras, m) [m].

    At full level: T (w - y), of the plate's motion w and the base y that stands for the current
    (`Exciter.base`). free: the rig's plate. Without fingers, under which it moves less.
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
    """The excursions within the rig's frequencies and by its level; free: its plate, if solved."""
    limits, exciters = rig.limits, exciters_of(rig)
    low, high = limits.frequency_min, limits.frequency_max
    frequencies = np.append(np.arange(low, high, _CHECKED), high)
    free = free or solve_free_plate(rig.plate, rig.mesh, frequency_max=high)
    settled = np.abs(relative_motions(rig, free, frequencies[:1])).sum(axis=1)[0]
    largest = np.zeros((len(frequencies), len(exciters)))
    some = [number for number, one in enumerate(exciters) if math.isfinite(one.excursion)]
    if some:
        largest[:, some] = limits.level * magnets_of(rig, free).by_jumps(frequencies)
    passed = largest > np.array([one.excursion for one in exciters])
    rows = np.flatnonzero(passed.any(axis=1))
    allowed = low
    if len(rows):
        allowed = float(frequencies[rows[-1] + 1]) if rows[-1] + 1 < len(passed) else math.inf
    return Excursions(
        limits.level * settled, largest.max(axis=0), np.asarray(passed.any(axis=0)), allowed
    )
