"""Answers of a table as JSON: the lines of a batch in, one object each out."""

import cmath
import math
import time
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from model.answer.answer import Answer, Layer
from model.answer.exposure import exposures
from model.answer.fingers import BY_NAME, MUST, Finger, Stimulus
from model.answer.measures import Measures, measures
from model.answer.plan import answer, prepare_answers
from model.answer.search import APART_HZ
from model.answer.timing import Timing
from model.arrays import Point, nullable
from model.errors import InputError
from model.finger import STRONG_DB_SL, highest_measured
from model.table.table import LocalizationTable
from model.transients.base_motion import Envelopes
from registry.wording import first_problem

_Place = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Own(BaseModel):
    """Schema of a finger with a vibration of its own: what `Stimulus` and `Finger` have."""

    model_config = ConfigDict(extra="forbid")

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
        """The finger; level_db_sl: that of the line."""
        given = self.model_dump(exclude_none=True)
        at = _point(given.pop("at"))
        if self.band_hz is not None:
            given["band_hz"] = _point(self.band_hz)
        keys = [key for key in Stimulus.__dataclass_fields__ if key in given]
        stimulus = {"level_db_sl": level_db_sl} | {key: given.pop(key) for key in keys}
        return Finger(at, Stimulus(**stimulus), **given)


class _Line(BaseModel):
    """Schema of a line of a batch."""

    model_config = ConfigDict(extra="forbid")

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
"""Keys of a line that only one of both kinds of questions has."""


def _parsed(line: str | Mapping[str, Any], defaults: Mapping[str, Any]) -> _Line:
    """A question, as JSON or as its keys and values; raises InputError."""
    try:
        if isinstance(line, str):
            asked = _Line.model_validate_json(line)
        else:
            asked = _Line.model_validate(line)
    except ValidationError as error:
        key, rule = first_problem(error)
        raise InputError(
            f"{key}: {rule}"
            if key
            else 'line must be a JSON object such as {"target": [0.08, 0.06], "quiet": '
            f"[[0.22, 0.16]]}}; {rule}"
        ) from None
    given = asked.model_fields_set
    if others := given & (_OF_TARGETS if asked.own else _OF_OWN):
        without = "without" if asked.own else "with"
        raise InputError(f"{', '.join(sorted(others))} must be given {without} own")
    if {"target", "targets"} <= given:
        raise InputError("target must be given without targets; name all of them there")
    return asked.model_copy(update={k: v for k, v in defaults.items() if k not in given})


def answer_as_json(table: LocalizationTable, asked: _Line, timing: Timing) -> dict[str, Any]:
    """Answer a line; with vibrations of their own its loads are those of the quiet fingers."""
    if asked.own:
        fingers = [each.finger(asked.level_db_sl) for each in asked.own]
        loads = _loads(asked, len(asked.quiet), what="quiet finger")
    else:
        targets = [*([] if asked.target is None else [asked.target]), *asked.targets]
        stimulus = Stimulus(asked.level_db_sl, duration=asked.duration, name="target")
        loads = _loads(asked, len(targets) + len(asked.quiet), what="finger")
        fingers = [Finger(_point(at), stimulus, loads.pop(0), sharing=MUST) for at in targets]
    started = time.perf_counter()
    found = answer(
        table,
        fingers,
        quiet=[Finger(_point(at), load=load) for at, load in zip(asked.quiet, loads, strict=True)],
        drive_mode=asked.mode,
        shaped=asked.envelopes,
        apart_hz=asked.apart_hz,
        bands_may_swap=asked.bands_may_swap,
    )
    if asked.envelopes:
        found = timing.shaped(found)
    elapsed = time.perf_counter() - started
    more = None if asked.own else measures(table, found, timing=timing)
    return _shown(table, found, more) | {"solve_time_s": elapsed}


def _loads(asked: _Line, count: int, *, what: str) -> list[float]:
    loads = asked.loads or [1.0] * count
    if len(loads) != count:
        raise InputError(f"loads must have one value per {what} ({count}), got {len(loads)}")
    return [*loads]


def _point(pair: list[float]) -> Point:
    return pair[0], pair[1]


def _shown(table: LocalizationTable, found: Answer, more: Measures | None) -> dict[str, Any]:
    """The JSON object of an answer; more: measures of a vibration that all targets share."""
    shown: dict[str, Any] = {
        "fingers": [
            {
                "at_m": list(each.finger.at),
                "verdict": each.verdict,
                "is_foreign_felt": each.is_foreign_felt,
                "layer": each.layer,
                "level_db_sl": nullable(each.level_db_sl),
                "promised_level_db_sl": nullable(each.promised_level_db_sl),
                "contrast_db": nullable(each.contrast_db),
                "median_contrast_db": nullable(each.median_contrast_db),
                "promised_contrast_db": nullable(each.promised_contrast_db),
                "foreign_level_db_sl": nullable(each.foreign_level_db_sl),
                "lowered_db": each.lowered_db,
                "exposure_m_s2": exposure,
            }
            for each, exposure in zip(found.fingers, exposures(table, found), strict=True)
        ],
        "layers": [_layer_as_json(each, table) for each in found.layers],
        "promised_worst_db": nullable(found.promised_worst_db),
        "stroke_factor": found.stroke_factor,
        "applied": list(found.applied),
    }
    if more is not None:
        near = more.concentration
        shown |= {
            "transient_contrast_db": more.transient_contrast_db,
            "residual_db": more.residual_db,
            "surroundings_contrast_95_db": near and near.contrast_95_db,
            "area_above_half_m2": near and near.area_above_half,
            "energy_share_near": near and near.energy_share_near,
            "is_imperceptible_to_quiet": more.is_imperceptible_to_quiet,
        }
    return shown


def _layer_as_json(layer: Layer, table: LocalizationTable) -> dict[str, Any]:
    highest = max([tone.frequency for tone in layer.excitation.values()], default=0.0)
    return {
        "frequency_hz": layer.frequency,
        "drive": table.drive_of(layer.excitation),
        "side_bands": [table.drive_of(each) for each in layer.side_bands],
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
    """Return level 0..1 of the stroke and phase at the start and at every knot, by ERA."""
    if envelopes is None:
        return None

    def shown(name: str, amplitude: complex) -> dict[str, float]:
        level = abs(amplitude) / table.full_levels[name]
        return {"level": level, "phase_deg": math.degrees(cmath.phase(amplitude))}

    return {
        name: {
            "frequency_hz": envelope.frequency,
            "step_s": envelope.step,
            "start": shown(name, envelope.start),
            "knots": [shown(name, knot) for knot in envelope.knots],
        }
        for name, envelope in envelopes.items()
    }


def query_one(table: LocalizationTable, values: Mapping[str, Any]) -> dict[str, Any]:
    """Answer one question, of the keys of a batch's line. Raises InputError."""
    asked, timing = _parsed(values, {}), Timing(table)
    prepare_answers(table, asked.mode)
    timing.prepare(table.frequencies.tolist())
    return answer_as_json(table, asked, timing)


def query_batch(
    table: LocalizationTable,
    lines: Iterable[str],
    defaults: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[dict[str, Any]]:
    """Answer every line that is not empty; `{"error": ..., "line": n}` for one without answer.

    defaults: of keys that lines leave out.
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
