"""Results derived from an answer on request, and answers as JSON.

- `Timing` shapes onsets and endings of layers and evaluates them in time.
- `measures`: transients and residual vibration of an answer's first layer, and its concentration
  over the plate.
- `exposures`: vibration at each finger with the hand-arm weighting of ISO 5349-1. A level above the
  threshold does not show long-term harm, which depends on frequency-weighted acceleration
  (docs/concepts/people.md).
- `query_one`, `query_batch`: queries as JSON objects, and their answers.
"""

import cmath
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from model.answer.answer import (
    APART_HZ,
    IMPERCEPTIBLE_DB_SL,
    QUIET,
    Answer,
    Layer,
    Sensation,
)
from model.answer.fingers_on_plate import FingersOnPlate
from model.answer.plan import answer, prepare_answers
from model.answer.promise import drawn_percentile, loudest_power
from model.answer.question import PROMISED_PERCENTILE
from model.answer.stimulus import ANY_BAND, BY_NAME, MUST, Finger, Placement, Stimulus
from model.arrays import Float32Array, FloatArray, Point, lattice, nullable
from model.ensemble.draws import PROMISED_DRAWS
from model.errors import InputError
from model.finger import (
    STRONG_DB_SL,
    decibels,
    fingertip_points,
    fingertip_weights,
    highest_measured,
    is_beyond,
)
from model.structure.plate import Plate
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.transients.base_motion import Envelopes, ramped_ending, ramped_onset, shaped
from model.transients.shaping import Shaper, Transients
from registry.wording import first_problem


class Timing:
    """Shapes and evaluates layers in time, on the plate of a table.

    Takes about ten milliseconds to build, and one more at the first use of each frequency.
    """

    def __init__(self, table: LocalizationTable) -> None:
        self._table, self._eras = table, table.eras
        self._shaper = Shaper(
            table.in_time,
            gain_variance=table.uncertainty.gain_variance(len(table.eras)),
            fingertips=partial(_few_points, table),
            magnets=table.magnets,
        )

    def prepare(self, frequencies: Iterable[float]) -> None:
        """Compute the data for shaping at frequencies [Hz] in advance."""
        for frequency in frequencies:
            self._shaper.prepare(frequency)

    def with_envelopes(
        self, layer: Layer, placement: Placement, *, onset: bool = True, ending: bool = True
    ) -> Layer:
        """Add a shaped onset, a shaped ending or both to a layer; takes a few milliseconds.

        Without other fingers the onset keeps the rest of the plate quiet. Envelopes are computed
        for the plate without fingers; with fingers they would gain 1 to 1.5 dB of contrast over the
        first 100 ms, and take 6 ms longer.
        """
        targets, quiet, tones = placement.targets, placement.quiet, layer.excitation
        if onset:
            envelopes = self._shaper.onset(tones, targets=targets, quiet=quiet)
            layer = replace(layer, onset=envelopes)
        if ending:
            envelopes = self._shaper.ending(tones, targets=targets, quiet=quiet)
            layer = replace(layer, ending=envelopes)
        return layer

    def shaped(self, result: Answer) -> Answer:
        """Add onsets and endings to all layers of an answer computed for shaped ones."""
        envelopes: list[tuple[Envelopes | None, Envelopes | None]] = []
        for layer in result.layers:
            shaped_layer = self.with_envelopes(layer, result.placement(layer))
            envelopes.append((shaped_layer.onset, shaped_layer.ending))
        return replace(result, envelopes=tuple(envelopes))

    def transient_contrast_db(self, layer: Layer, placement: Placement) -> float | None:
        """Contrast over the first 100 ms [dB] along the onset or the ramp, with fingers on the
        plate.

        None without quiet fingers.
        """
        if not placement.quiet:
            return None
        if layer.onset is None:
            onset = ramped_onset(layer.excitation, self._eras, ramp=layer.ramp)
        else:
            onset = shaped(layer.onset, self._eras)
        targets, quiet = placement.targets, placement.quiet
        return self._under(placement).contrast_db(onset, targets=targets, quiet=quiet)

    def residual_db(self, layer: Layer, placement: Placement) -> float:
        """Residual vibration in the 100 ms after the end, relative to the steady one [dB]."""
        if layer.ending is None:
            ending = ramped_ending(layer.excitation, self._eras, ramp=layer.ramp)
        else:
            ending = shaped(layer.ending, self._eras)
        return self._under(placement).residual_db(layer.excitation, ending)

    def _under(self, placement: Placement) -> Transients:
        return Transients(self._table.in_time_under(placement.contacts, placement.loads))


def _few_points(table: LocalizationTable, places: Sequence[Point]) -> tuple[FloatArray, FloatArray]:
    """Weights (k, p) of few points under fingertips, and their shapes (k, p, r)."""
    tips = read_fingertips(table, places)
    return tips.few_weights.astype(float), tips.few.astype(float)


_SPACING = 0.0025  # m; resolves the area of a 50 mm circle to a percent
_PERCENTILE = 95


@dataclass(frozen=True)
class Concentration:
    """Concentration of a vibration around its targets."""

    contrast_95_db: float
    """Peak acceleration at the targets relative to the 95th percentile over the plate beyond
    50 mm."""
    area_above_half: float
    """Area of the plate, targets included, that vibrates more than half as much as they do [m²]."""
    energy_share_near: float
    """Fraction of the kinetic energy within 50 mm of the targets."""


@dataclass(frozen=True)
class Measures:
    """Measures of an answer's first layer that take about ten milliseconds to compute."""

    transient_contrast_db: float | None
    """Contrast of accelerations over the first 100 ms, None without other fingers."""
    residual_db: float
    """Residual vibration in the 100 ms after the end, relative to the steady vibration."""
    concentration: Concentration | None
    """How well the vibration is confined to a single finger; None with other fingers."""
    is_imperceptible_to_quiet: bool | None
    """Whether quiet fingers stay 10 dB below all threshold sets, on 90 % of plates."""


def measures(table: LocalizationTable, answer: Answer, *, timing: Timing | None = None) -> Measures:
    """Compute the measures of the first layer of an answer, in time and over the whole plate."""
    timing = timing or Timing(table)
    layer = answer.layers[0]
    placement = answer.placement(layer)
    levels_db_sl = []
    for sensation in answer.fingers:
        level_db_sl = sensation.foreign_level_db_sl
        if sensation.verdict == QUIET and level_db_sl is not None:
            levels_db_sl.append(level_db_sl)
    return Measures(
        transient_contrast_db=timing.transient_contrast_db(layer, placement),
        residual_db=timing.residual_db(layer, placement),
        concentration=None if placement.quiet else concentration(table, layer, placement),
        is_imperceptible_to_quiet=(
            max(levels_db_sl) <= IMPERCEPTIBLE_DB_SL if levels_db_sl else None
        ),
    )


def concentration(table: LocalizationTable, layer: Layer, placement: Placement) -> Concentration:
    """Compute the concentration of a layer without quiet fingers; takes some milliseconds."""
    plate = table.plate
    contacts = placement.targets
    amplitudes_at = partial(
        table.amplitudes, layer.excitation, contacts=contacts, loads=placement.loads
    )
    felt = []
    for target in contacts:
        _, disc_amplitudes = amplitudes_at(fingertip_points(*target, plate))
        felt.append(disc_amplitudes.sum(axis=0) @ fingertip_weights(*target, plate))
    points = cell_centers(plate)
    frequencies, amplitudes = amplitudes_at(points)
    near = ~is_beyond(points, contacts)
    return concentration_of(frequencies, amplitudes, near, felt=min(felt), plate=plate)


def cell_centers(plate: Plate) -> FloatArray:
    """Return the centers (p, 2) [m] of small equal cells that tile the plate."""
    return lattice(_cell_middles(plate.length), _cell_middles(plate.width))


def _cell_middles(side: float) -> FloatArray:
    """Return the middles (n,) [m] of equal cells along a side [m]."""
    count = max(1, round(side / _SPACING))
    return np.linspace(0, side, 2 * count + 1)[1::2]


def concentration_of(
    frequencies: FloatArray,
    amplitudes: FloatArray,
    near: NDArray[np.bool_],
    *,
    felt: float,
    plate: Plate,
) -> Concentration:
    """Evaluate a vibration with amplitudes (f, p) [m/s²] at `cell_centers`, frequencies (f,) [Hz].

    near (p,): centers within 50 mm of a target; felt [m/s²]: mean amplitude at the least driven
    target. Energy is kinetic, for uniform mass. If all centers are near, contrast is relative to
    all.
    """
    peak = amplitudes.sum(axis=0)
    around = peak if near.all() else peak[~near]
    energy = ((amplitudes.T / frequencies) ** 2).sum(axis=1)
    return Concentration(
        contrast_95_db=float(decibels(felt / np.percentile(around, _PERCENTILE))),
        area_above_half=float((peak > felt / 2).mean()) * plate.length * plate.width,
        energy_share_near=float(energy[near].sum() / energy.sum()),
    )


# Hz; band limits 10^0.8 and 10^3.1, and the corner where the weighting begins to fall.
_LOW, _HIGH, _FALL = 10**0.8, 10**3.1, 100 / (2 * np.pi)

_BAND_Q, _FALL_Q = 1 / np.sqrt(2), 0.64


def hand_weighting(frequencies: FloatArray) -> FloatArray:
    """Return the weighting Wh at frequencies [Hz], in their shape: 0.96 at 12.5 Hz, 0.063 at 250.

    A band from 6.3 to 1259 Hz, second-order Butterworth on both sides, with a transition from
    acceleration to velocity at 15.9 Hz (ISO 5349-1:2001, annex A; ISO 8041).
    """
    s = 1j * np.asarray(frequencies)
    high_pass = s**2 / (s**2 + _LOW / _BAND_Q * s + _LOW**2)
    band = high_pass * _HIGH**2 / (s**2 + _HIGH / _BAND_Q * s + _HIGH**2)
    fall = (s + _FALL) * _FALL / (s**2 + _FALL / _FALL_Q * s + _FALL**2)
    return np.asarray(np.abs(band * fall))


def exposures(table: LocalizationTable, result: Answer) -> list[float]:
    """Return the weighted RMS acceleration at each finger of an answer [m/s²].

    Normal to the plate, for all vibrations together at full strength, at the loudest point of the
    fingertip; 90 % of plates do not exceed it. Harmonics above 1 kHz, where thresholds end, are
    ignored.
    """
    tones = result.tones
    contents = result.contents
    if not tones.rows:
        return [0.0] * len(result.asked)
    rows = np.array(tones.rows)
    gains = np.array(tones.gains)
    weights = np.array(tones.weights, dtype=np.complex64)
    frequencies = table.frequencies[rows]
    factors = _mean_squares(gains, table.thresholds[rows], frequencies)
    harmonic_factors = _mean_squares(
        gains, table.compared_harmonic_thresholds[rows], 2 * frequencies
    )
    fingers = FingersOnPlate.of(table, contents.places, contents.loads)
    power = fingers.powers(PROMISED_DRAWS, rows, weights) * factors[:, None, None, None]
    harmonics = fingers.harmonics(PROMISED_DRAWS, rows, weights) * harmonic_factors[:, None, None]
    weighted = []
    for finger in range(len(result.asked)):
        mean_square = loudest_power(power, harmonics, rows, finger)
        weighted.append(drawn_percentile(np.sqrt(mean_square), 100 - PROMISED_PERCENTILE))
    return weighted


def _mean_squares(
    gains: FloatArray, thresholds: Float32Array, frequencies: FloatArray
) -> Float32Array:
    """Return the weighted mean square (m,) of tones with gains, relative to the threshold.

    0 beyond the thresholds, which are infinite there.
    """
    known = np.where(np.isfinite(thresholds), thresholds, 0.0)
    mean_squares = (gains * known * hand_weighting(frequencies)) ** 2 / 2
    return mean_squares.astype(np.float32)


def query_one(table: LocalizationTable, values: Mapping[str, Any]) -> dict[str, Any]:
    """Answer a query with the keys of a batch line. Raises InputError."""
    line = _parsed(values, {})
    timing = Timing(table)
    prepare_answers(table, line.mode)
    timing.prepare(table.frequencies.tolist())
    return answer_as_json(table, line, timing)


def query_batch(
    table: LocalizationTable,
    lines: Iterable[str],
    defaults: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[dict[str, Any]]:
    """Answer every non-empty line; a failed query yields an `error` and its `line`.

    defaults: values of missing keys.
    """
    prepare_answers(table)
    timing = Timing(table)
    timing.prepare(table.frequencies.tolist())
    for number, line in enumerate(lines, start=1):
        if line.strip():
            try:
                yield answer_as_json(table, _parsed(line, defaults), timing)
            except InputError as error:
                yield {"error": str(error), "line": number}


_Place = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Own(BaseModel):
    """Schema of a finger with its own vibration, with the fields of `Stimulus` and `Finger`."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    at: _Place
    level_db_sl: float | None = None
    band_hz: _Place | None = None
    duration: float | None = None
    modulation_hz: float | None = None
    is_limit: bool = False
    name: str | None = None
    load: float = 1.0
    priority: int = 0
    sharing: str = BY_NAME
    is_protected: bool = True

    def finger(self, level_db_sl: float) -> Finger:
        """Build the finger; level_db_sl: the line's level, for a finger without a level."""
        if self.level_db_sl is not None:
            level_db_sl = self.level_db_sl
        stimulus = Stimulus(
            level_db_sl,
            ANY_BAND if self.band_hz is None else _point(self.band_hz),
            duration=self.duration,
            modulation_hz=self.modulation_hz,
            is_limit=self.is_limit,
            name=self.name,
        )
        return Finger(
            _point(self.at),
            stimulus,
            load=self.load,
            priority=self.priority,
            sharing=self.sharing,
            is_protected=self.is_protected,
        )


class _Line(BaseModel):
    """Schema of a line of a batch."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    target: _Place | None = None
    targets: list[_Place] = []
    own: list[_Own] = []
    quiet: list[_Place] = []
    bands_may_swap: bool = False
    apart_hz: float = APART_HZ
    mode: str | None = None
    level_db_sl: float = STRONG_DB_SL
    duration: float | None = None
    envelopes: bool = False
    loads: list[float] = []


_OF_TARGETS = {"target", "targets", "duration"}

_OF_OWN = {"bands_may_swap", "apart_hz"}
"""Keys of a line that are valid for only one of the two kinds of queries."""


def _parsed(line: str | Mapping[str, Any], defaults: Mapping[str, Any]) -> _Line:
    """Validate a query given as JSON or as keys and values; raises InputError."""
    try:
        if isinstance(line, str):
            parsed = _Line.model_validate_json(line)
        else:
            parsed = _Line.model_validate(line)
    except ValidationError as error:
        key, rule = first_problem(error)
        if key:
            raise InputError(f"{key}: {rule}") from None
        example = '{"target": [0.08, 0.06], "quiet": [[0.22, 0.16]]}'
        raise InputError(f"line must be a JSON object such as {example}; {rule}") from None
    keys = parsed.model_fields_set
    misplaced = keys & (_OF_TARGETS if parsed.own else _OF_OWN)
    if misplaced:
        without = "without" if parsed.own else "with"
        raise InputError(f"{', '.join(sorted(misplaced))} must be given {without} own")
    if {"target", "targets"} <= keys:
        raise InputError("target must be given without targets; list all fingers in targets")
    missing = {key: value for key, value in defaults.items() if key not in keys}
    return parsed.model_copy(update=missing)


def answer_as_json(table: LocalizationTable, line: _Line, timing: Timing) -> dict[str, Any]:
    """Answer a line; its loads belong to the quiet fingers if others have their own vibrations."""
    if line.own:
        fingers = [finger.finger(line.level_db_sl) for finger in line.own]
        quiet_loads = _loads(line, len(line.quiet), what="quiet finger")
    else:
        targets = [*line.targets] if line.target is None else [line.target, *line.targets]
        stimulus = Stimulus(line.level_db_sl, duration=line.duration, name="target")
        loads = _loads(line, len(targets) + len(line.quiet), what="finger")
        fingers = []
        for at, load in zip(targets, loads, strict=False):
            fingers.append(Finger(_point(at), stimulus, load, sharing=MUST))
        quiet_loads = loads[len(targets) :]
    quiet = []
    for at, load in zip(line.quiet, quiet_loads, strict=True):
        quiet.append(Finger(_point(at), load=load))
    started = time.perf_counter()
    result = answer(
        table,
        fingers,
        quiet=quiet,
        drive_mode=line.mode,
        shaped=line.envelopes,
        apart_hz=line.apart_hz,
        bands_may_swap=line.bands_may_swap,
    )
    if line.envelopes:
        result = timing.shaped(result)
    elapsed = time.perf_counter() - started
    result_measures = None if line.own else measures(table, result, timing=timing)
    return _as_json(table, result, result_measures) | {"solve_time_s": elapsed}


def _loads(line: _Line, count: int, *, what: str) -> list[float]:
    loads = line.loads or [1.0] * count
    if len(loads) != count:
        raise InputError(f"loads must have one value per {what} ({count}), got {len(loads)}")
    return [*loads]


def _point(pair: list[float]) -> Point:
    return pair[0], pair[1]


def _as_json(
    table: LocalizationTable, result: Answer, result_measures: Measures | None
) -> dict[str, Any]:
    """Return the JSON object of an answer, with its measures if all targets share a vibration."""
    fingers = []
    for sensation, exposure in zip(result.fingers, exposures(table, result), strict=True):
        fingers.append(_sensation_as_json(sensation) | {"exposure_m_s2": exposure})
    document: dict[str, Any] = {
        "fingers": fingers,
        "layers": [_layer_as_json(layer, table) for layer in result.layers],
        "promised_worst_db": nullable(result.promised_worst_db),
        "stroke_factor": result.stroke_factor,
        "applied": list(result.applied),
    }
    if result_measures is not None:
        document |= _measures_as_json(result_measures)
    return document


def _sensation_as_json(sensation: Sensation) -> dict[str, Any]:
    return {
        "at_m": list(sensation.finger.at),
        "verdict": sensation.verdict,
        "is_foreign_felt": sensation.is_foreign_felt,
        "layer": sensation.layer,
        "level_db_sl": nullable(sensation.level_db_sl),
        "promised_level_db_sl": nullable(sensation.promised_level_db_sl),
        "contrast_db": nullable(sensation.contrast_db),
        "median_contrast_db": nullable(sensation.median_contrast_db),
        "promised_contrast_db": nullable(sensation.promised_contrast_db),
        "foreign_level_db_sl": nullable(sensation.foreign_level_db_sl),
        "rig_foreign_level_db_sl": nullable(sensation.rig_foreign_level_db_sl),
        "lowered_db": sensation.lowered_db,
    }


def _measures_as_json(result_measures: Measures) -> dict[str, Any]:
    near = result_measures.concentration
    return {
        "transient_contrast_db": result_measures.transient_contrast_db,
        "residual_db": result_measures.residual_db,
        "surroundings_contrast_95_db": near and near.contrast_95_db,
        "area_above_half_m2": near and near.area_above_half,
        "energy_share_near": near and near.energy_share_near,
        "is_imperceptible_to_quiet": result_measures.is_imperceptible_to_quiet,
    }


def _layer_as_json(layer: Layer, table: LocalizationTable) -> dict[str, Any]:
    highest = max([tone.frequency for tone in layer.excitation.values()], default=0.0)
    return {
        "frequency_hz": layer.frequency,
        "drive": table.drive_of(layer.excitation),
        "side_bands": [table.drive_of(side_band) for side_band in layer.side_bands],
        "fingers": list(layer.fingers),
        "mode": layer.drive_mode,
        "ramp_s": layer.ramp,
        "onset": _envelopes_as_json(layer.onset, table),
        "ending": _envelopes_as_json(layer.ending, table),
        "contrast_to_plate_db": layer.contrast_to_plate_db,
        "is_level_extrapolated": highest > highest_measured(table.threshold),
    }


def _envelopes_as_json(
    envelopes: Envelopes | None, table: LocalizationTable
) -> dict[str, Any] | None:
    """Return level (0 to 1 of full stroke) and phase at the start and at every knot, by ERA."""
    if envelopes is None:
        return None

    def level_and_phase(name: str, amplitude: complex) -> dict[str, float]:
        level = abs(amplitude) / table.full_levels[name]
        return {"level": level, "phase_deg": math.degrees(cmath.phase(amplitude))}

    return {
        name: {
            "frequency_hz": envelope.frequency,
            "step_s": envelope.step,
            "start": level_and_phase(name, envelope.start),
            "knots": [level_and_phase(name, knot) for knot in envelope.knots],
        }
        for name, envelope in envelopes.items()
    }
