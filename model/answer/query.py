"""Queries of a table with all measures, and their JSON."""

import cmath
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from model.answer.answer import answer
from model.answer.concentration import with_concentration
from model.answer.pattern import Pattern
from model.answer.pattern_query import find_pattern, prepare_patterns
from model.answer.question import Question
from model.answer.request import APART_HZ, Finger, Request
from model.answer.timing import Timing
from model.arrays import nullable
from model.drive_modes import UNRESTRICTED
from model.errors import InputError
from model.finger.perception import STRONG_DB_SL
from model.table.table import LocalizationTable
from model.transients.base_motion import Envelopes
from registry.wording import first_problem

_Place = Annotated[list[float], Field(min_length=2, max_length=2)]


class _Own(BaseModel):
    """Schema of a finger with a content of its own."""

    model_config = ConfigDict(extra="forbid")

    at: _Place
    band_hz: _Place | None = None
    level_db_sl: float | None = None
    priority: int = 0
    may_share: bool = False
    is_protected: bool = True
    load: float = 1.0
    modulation_hz: float | None = None


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
    envelopes: bool = False
    loads: list[float] = []


_OF_TARGETS = {"target", "targets", "mode", "envelopes"}
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


def query_table(
    table: LocalizationTable,
    question: Question,
    timing: Timing,
    *,
    measures: bool = True,
) -> tuple[Pattern, float]:
    """Query a table; also return the time [s] that the pattern took without its measures.

    The pattern has envelopes if the question wants them; measures: compute those in time and over
    the whole plate.
    """
    started = time.perf_counter()
    pattern = find_pattern(table, question)
    if question.envelopes:
        pattern = timing.with_envelopes(question, pattern)
    elapsed = time.perf_counter() - started
    if not measures:
        return pattern, elapsed
    pattern = timing.with_transient_measures(question, pattern)
    return with_concentration(table, question, pattern), elapsed


def query_as_json(table: LocalizationTable, question: Question, timing: Timing) -> dict[str, Any]:
    """Query a table with all measures and return the JSON object of `era table query`."""
    pattern, elapsed = query_table(table, question, timing)
    concentration = pattern.concentration
    return {
        "drive": table.drive_of(pattern.excitation),
        "mode": pattern.drive_mode,
        "level_db_sl": pattern.level_db_sl,
        "is_level_extrapolated": pattern.is_level_extrapolated,
        "robust_level_db_sl": pattern.robust_level_db_sl,
        "felt_contrast_db": pattern.felt_contrast_db,
        "robust_felt_contrast_db": pattern.robust_felt_contrast_db,
        "median_felt_contrast_db": pattern.median_felt_contrast_db,
        "contrast_db": pattern.contrast_db,
        "robust_contrast_db": pattern.robust_contrast_db,
        "transient_contrast_db": pattern.transient_contrast_db,
        "residual_db": pattern.residual_db,
        "surroundings_contrast_db": pattern.surroundings_contrast_db,
        "surroundings_contrast_95_db": concentration and concentration.contrast_95_db,
        "area_above_half_m2": concentration and concentration.area_above_half,
        "energy_share_near": concentration and concentration.energy_share_near,
        "quiet_level_db_sl": pattern.quiet_level_db_sl,
        "robust_quiet_level_db_sl": pattern.robust_quiet_level_db_sl,
        "is_imperceptible_to_quiet": pattern.is_imperceptible_to_quiet,
        "usable_level_db_sl": pattern.usable_level_db_sl,
        "ramp_s": pattern.ramp,
        "onset": _envelopes_as_json(pattern.onset, table),
        "ending": _envelopes_as_json(pattern.ending, table),
        "solve_time_s": elapsed,
    }


def _answer_to(table: LocalizationTable, asked: _Line, timing: Timing) -> dict[str, Any]:
    """Answer a line; with contents of their own its loads are those of the quiet fingers."""
    quiet = tuple((x, y) for x, y in asked.quiet)
    if not asked.own:
        targets = [*([] if asked.target is None else [asked.target]), *asked.targets]
        question = Question(
            targets=tuple((x, y) for x, y in targets),
            quiet=quiet,
            level_db_sl=asked.level_db_sl,
            drive_mode=asked.mode,
            envelopes=asked.envelopes,
            loads=tuple(asked.loads),
        )
        return query_as_json(table, question, timing)
    requests = []
    for each in asked.own:
        given = each.model_dump(exclude_none=True)
        pairs = {key: tuple(given[key]) for key in ("at", "band_hz") if key in given}
        requests.append(Request(**{"level_db_sl": asked.level_db_sl} | given | pairs))
    loads = asked.loads or [1.0] * len(quiet)
    if len(loads) != len(quiet):
        raise InputError(
            f"loads must have one value per quiet finger ({len(quiet)}), got {len(loads)}"
        )
    return answer_as_json(
        table,
        requests,
        [Finger(at, load) for at, load in zip(quiet, loads, strict=True)],
        apart_hz=asked.apart_hz,
        bands_may_swap=asked.bands_may_swap,
    )


def answer_as_json(
    table: LocalizationTable,
    requests: Sequence[Request],
    fingers: Sequence[Finger] = (),
    *,
    apart_hz: float = APART_HZ,
    bands_may_swap: bool = False,
) -> dict[str, Any]:
    """Answer requests as `model.answer.answer` and return the JSON object of `--own`."""
    started = time.perf_counter()
    found = answer(
        table,
        requests,
        fingers,
        apart_hz=apart_hz,
        bands_may_swap=bands_may_swap,
        drive_mode=UNRESTRICTED,
    )
    elapsed = time.perf_counter() - started
    layers = []
    for layer in found.layers:
        tones = layer.excitation
        layers.append(
            {
                "at_m": list(layer.request.at),
                "frequency_hz": layer.frequency,
                # A shared content is played once, where it was asked for first.
                "drive": {} if layer.verdict == "shared" else table.drive_of(tones),
                "level_db_sl": layer.level_db_sl if tones else None,
                "promised_level_db_sl": layer.promised_level_db_sl if tones else None,
                "felt_contrast_db": nullable(layer.felt_contrast_db),
                "median_felt_contrast_db": nullable(layer.median_felt_contrast_db),
                "robust_felt_contrast_db": nullable(layer.promised_contrast_db),
                "foreign_level_db_sl": nullable(layer.foreign_level_db_sl),
                "verdict": layer.verdict,
                "side_bands": []
                if layer.verdict == "shared"
                else [table.drive_of(each) for each in layer.side_bands],
            }
        )
    quiet = [
        {
            "at_m": list(each.at),
            "felt_contrast_db": each.felt_contrast_db,
            "robust_felt_contrast_db": each.promised_contrast_db,
            "foreign_level_db_sl": each.level_db_sl,
        }
        for each in found.quiet
    ]
    return {
        "layers": layers,
        "quiet": quiet,
        "robust_worst_db": nullable(found.promised_worst_db),
        "stroke_factor": found.stroke_factor,
        "applied": list(found.applied),
        "solve_time_s": elapsed,
    }


def _envelopes_as_json(
    envelopes: Envelopes | None, table: LocalizationTable
) -> dict[str, Any] | None:
    """Return level 0..1 of the stroke and phase at the start and at every knot, by ERA."""
    if envelopes is None:
        return None

    def shown(name: str, amplitude: complex) -> dict[str, float]:
        level = abs(amplitude) / table.strokes[name]
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
    prepare_patterns(table, UNRESTRICTED if asked.own else asked.mode, with_ringing=False)
    if not asked.own:  # contents of their own have no envelopes
        timing.prepare(table.frequencies.tolist())
    return _answer_to(table, asked, timing)


def query_batch(
    table: LocalizationTable,
    lines: Iterable[str],
    defaults: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[dict[str, Any]]:
    """Answer every line that is not empty; `{"error": ..., "line": n}` for one without answer.

    defaults: of keys that lines leave out.
    """
    prepare_patterns(table, with_ringing=False)
    timing = Timing(table)
    timing.prepare(table.frequencies.tolist())
    for number, line in enumerate(lines, start=1):
        if line.strip():
            try:
                yield _answer_to(table, _parsed(line, defaults), timing)
            except InputError as error:
                yield {"error": str(error), "line": number}
