"""Match of a rig's plate to responses of its channels, up to gain and phase of each channel.

    d_fes ~ m_fe exp(i phi_fe) a_fes(x) + noise,   m_fe near G_e

d are measured values, a those of the model, G_e the gain of a channel. Magnitudes m vary about G_e
with frequency as those of real actuators do; phases phi are free, since they need not have been
measured. Both follow from x and G, so that only these are searched (variable projection). Gaussian
priors hold the parameters x near the rig's values: a large deviation is evidence against the rig.

Which ERA a channel drives follows from the modal assurance criterion (MAC) of shapes: 1 for the
same shape with any gain and phase, about one over the number of sensors for noise. Polarity follows
from phases."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtr

from model.arrays import ComplexArray, FloatArray, best_by, best_of
from model.estimate.calibration_fit import (
    STARTS,
    SensedPlate,
    fit_with_gains,
    modal_assurance,
    project_gains,
    row_rms,
    without_outliers,
)
from model.estimate.measurement import Responses, typical
from model.rig.rig import Rig

_GAIN_TOLERANCE = 0.08  # standard deviation over frequency, of itself
FALSE_ALARM = 0.01
"""Share of plates as written that a test of values, form or thickness calls wrong."""

MAX_FIT_ERROR = 0.2  # largest relative rms error of an acceptable plate
MODEL_ERROR = 0.05  # of a row's rms: scales and positions of sensors, and what is not modelled
_ROBUST = 2.0  # standard deviations
_MAX_OUTLIERS = 0.05  # of all values; of a plate 3 % longer than its rig's a tenth look like some

_MIN_COHERENCE = 0.6  # length of the mean of unit phasors of a reliable phase
_LEAST_MISFIT = 0.02  # below it sensors' errors dominate


@dataclass(frozen=True, eq=False)
class Match:
    """The best fit of a plate to values of channels."""

    rig: Rig
    """The rig with the fitted values."""
    plate: SensedPlate
    """The plate of the rig before the fit."""
    x: FloatArray
    """All parameters (p,)."""
    z: FloatArray
    """Deviation of each fitted value (n,), as `SensedPlate.deviations`."""
    gains: FloatArray
    """Magnitude of the gain of each channel (e,), NaN if not used."""
    cost: float
    """Half the sum of squares of robust residuals and of z."""
    error: float
    """Rms of the residuals relative to the rms of their row."""
    median_error: float
    """Median of the same."""
    responses: ComplexArray
    """Responses of the ERAs (f, e, s)."""
    predicted: ComplexArray
    """Responses of the ERAs that the channels drive, with gains (f, e, s)."""
    outliers: NDArray[np.bool_]
    """Mask of values that no error counts (f, e, s)."""

    @property
    def worst(self) -> float:
        """The largest of |z|."""
        return float(np.abs(self.z).max())

    @property
    def chance(self) -> float:
        """Upper limit of the share of plates as written with a value at least as far off."""
        return float(2 * len(self.z) * ndtr(-self.worst))


def match_plate(
    plate: SensedPlate,
    values: ComplexArray,
    *,
    drives: Sequence[int],
    model_error: float = MODEL_ERROR,
    starts: tuple[tuple[float, float], ...] = ((0.0, 0.0),),
) -> Match:
    """Fit a rig's plate at sensors to values (f, e, s) of channels.

    drives (e,): number of the ERA that each channel drives; model_error: relative to a row's rms;
    starts: logarithms of factors on the modulus and on all stiffnesses from which to search.
    """
    model, driven, size = plate.model, np.array(drives), row_rms(values)
    inside = np.isfinite(values)
    rows: NDArray[np.bool_] = np.asarray(inside.any(axis=2))
    used: NDArray[np.bool_] = np.asarray(rows.any(axis=0))
    gains_of = np.arange(model.space.size)[model.space.groups["gain"]][driven]
    searched = model.space.uncertain & ~model.space.of("gain")
    searched[gains_of[used]] = True
    std = model.space.std[gains_of]

    def relative_to(
        levels: FloatArray, which: NDArray[np.bool_] = inside
    ) -> tuple[ComplexArray, FloatArray]:
        """Values by channel relative to levels (e,), logarithms of gains; and weights of some."""
        scaled = values / np.exp(levels)[:, None]
        return scaled, which / (model_error * row_rms(scaled, which)[:, :, None])

    tried = []
    for start in starts:
        at, beside = plate.moved(*start), np.zeros(len(driven))
        found = row_rms(np.where(rows[:, :, None], plate.responses(at)[:, driven], np.nan))
        ratio = np.where(rows, np.log(np.maximum(size / found, 1e-6)), np.nan)
        levels = np.nanmedian(ratio[:, used], axis=0)
        at[gains_of[used]] = levels / std[used]
        # Two channels may drive one ERA: each has its own level beside the gain of the last one.
        beside[used] = levels - std[used] * at[gains_of[used]]
        best = fit_with_gains(
            model,
            *relative_to(beside),
            at,
            searched,
            robust=_ROBUST,
            drives=drives,
            tolerance=_GAIN_TOLERANCE,
        )
        tried.append((best, beside))
    best, beside = best_by(tried, lambda each: -each[0].cost)
    z = best.x
    predicted = plate.responses(z)[:, driven]
    outliers = _outliers(values, predicted)
    kept = inside & ~outliers
    _, residual = project_gains(predicted, *relative_to(beside, kept), tolerance=_GAIN_TOLERANCE)
    share = (model_error * np.abs(residual))[kept]
    gains = np.where(used, np.exp(beside + std * z[gains_of]), np.nan)
    return Match(
        plate.rig_at(z),
        plate,
        z,
        plate.deviations(z),
        gains,
        best.cost,
        math.sqrt(float((share**2).mean())) if len(share) else math.inf,
        float(np.median(share)) if len(share) else math.inf,
        plate.responses(np.where(plate.model.space.of("gain"), 0.0, z)),
        np.where(used[:, None], predicted * np.exp(beside)[:, None], np.nan),
        outliers,
    )


def _outliers(values: ComplexArray, predicted: ComplexArray) -> NDArray[np.bool_]:
    """Mask of the values (f, e, s) that a calibration would leave out as outliers.

    Empty where they are too many, and for a sensor most of whose values they are: such values are
    not accidental, but show that the plate, its wiring or the sensor's place is another one.
    """
    measured = np.isfinite(values)
    found = measured & ~without_outliers(values, predicted)[-1]
    found[:, :, found.sum(axis=(0, 1)) > measured.sum(axis=(0, 1)) / 2] = False
    return found & bool(found.sum() <= _MAX_OUTLIERS * measured.sum())


def plate_changes(rig: Rig, match: Match) -> dict[str, float]:
    """Relative differences of the most probable plate from a rig's, by kind of value.

    For ERAs it is their mean; bolts are skipped, since most rigs have none.
    """
    changes = {}
    for kind in ("modulus", "loss_factor", "stiffness", "damping"):
        found = [
            row.of(match.rig) / row.of(rig) - 1
            for row in match.plate.rows
            if row.kind == kind and row.of(rig)
        ]
        if found:
            changes[kind] = float(np.mean(found))
    return changes


@dataclass(frozen=True, eq=False)
class ShapeMatch:
    """MAC of channels and ERAs on the most similar plate."""

    mac: FloatArray
    """MAC (f, e, e) of the channel that the rig wires to the first ERA with the second ERA, NaN if
    not driven."""
    start: tuple[float, float]
    """Logarithms of that plate's factors on modulus and stiffnesses."""

    @property
    def starts(self) -> tuple[tuple[float, float], ...]:
        """Logarithms of factors from which to search: 0, and those of that plate."""
        return tuple(dict.fromkeys([(0.0, 0.0), self.start]))

    @property
    def nearest(self) -> tuple[int, ...]:
        """Index of the ERA most similar to each channel; its own if not driven."""
        found = np.array(
            [
                [typical(self.mac[:, i, j]) for j in range(self.mac.shape[2])]
                for i in range(self.mac.shape[1])
            ]
        )
        return tuple(
            best_of(np.nan_to_num(row, nan=-1.0)) if np.isfinite(row).any() else i
            for i, row in enumerate(found)
        )

    @property
    def error(self) -> float:
        """Share of the responses, rms, that the shapes of the nearest ERAs leave unexplained."""
        return self._error(self.nearest)

    @property
    def error_as_wired(self) -> float:
        """The same for the shapes of the ERAs to which the rig wires the channels."""
        return self._error(range(self.mac.shape[1]))

    def _error(self, eras: Sequence[int]) -> float:
        alike = self.mac[:, range(self.mac.shape[1]), eras]
        return (
            math.sqrt(max(0.0, float(np.nanmean(1 - alike))))
            if np.isfinite(alike).any()
            else math.inf
        )

    def confidence(self, channel: int, era: int, other: int) -> float:
        """Confidence 0..1 that the channel drives one ERA and not the other.

        By Student's t-test of the difference of their misfits over frequencies.
        """
        misfit = np.log(np.maximum(1 - self.mac[:, channel], _LEAST_MISFIT))
        gain = misfit[:, other] - misfit[:, era]
        gain = gain[np.isfinite(gain)]
        if len(gain) < 3 or np.ptp(gain) == 0:
            return 0.5
        t = gain.mean() * np.sqrt(len(gain)) / gain.std(ddof=1)
        return float(stdtr(len(gain) - 1, t))


def match_shapes(plate: SensedPlate, values: ComplexArray) -> ShapeMatch:
    """Compare values (f, e, s) with a rig's ERAs on plates of other modulus and stiffnesses."""
    tried = [
        match_responses(plate.responses(plate.moved(*start)), values, start)
        for start in [(0.0, 0.0), *STARTS]
    ]

    def score(found: ShapeMatch) -> float:
        alike = [typical(found.mac[:, i, j]) for i, j in enumerate(found.nearest)]
        # Values far from the rig's must be clearly better.
        return float(np.nansum(alike) - 0.05 * sum(map(abs, found.start)) * values.shape[1])

    return best_by(tried, score)


def match_responses(
    model: ComplexArray, values: ComplexArray, start: tuple[float, float] = (0.0, 0.0)
) -> ShapeMatch:
    """Compare values (f, e, s) with responses (f, e, s) of one plate."""
    return ShapeMatch(modal_assurance(values[:, :, None], model[:, None]), start)


@dataclass(frozen=True)
class ChannelPhase:
    """Phase error of a channel."""

    degrees: float | None = None
    """Phase error [degrees], None if unknown."""
    sign: int = 0
    """1 or -1, 0 if unknown."""
    confidence: float = 0.0
    """Confidence 0..1 in the phase."""


def phases_of_drive(observation: Responses, predicted: ComplexArray) -> list[ChannelPhase]:
    """Phases relative to the drive; predicted (f, e, s), NaN for channels to be skipped."""
    if not observation.has_phases:
        return [ChannelPhase()] * predicted.shape[1]
    found = []
    for channel in range(predicted.shape[1]):
        measured, model = observation.values[:, channel], predicted[:, channel]
        finite = np.isfinite(measured) & np.isfinite(model)
        inner = (np.where(finite, np.conj(model), 0) * np.where(finite, measured, 0)).sum(axis=1)
        inner = inner[np.abs(inner) > 0]
        mean = complex(np.mean(inner / np.abs(inner))) if len(inner) else 0j
        angle = math.degrees(np.angle(mean))
        found.append(
            ChannelPhase(angle, 1 if abs(angle) < 90 else -1, abs(mean))
            if abs(mean) >= _MIN_COHERENCE
            else ChannelPhase(confidence=abs(mean))
        )
    return found
