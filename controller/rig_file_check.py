"""Check of a rig file: errors with their keys, and warnings of lost contrast or risk to exciters.

These checks need the wires (`drivers`) and solved plates (`model.study`, `model.transients`).
Checks that need the values of the rig alone are in `model.rig.rig_warnings`.
"""

import contextlib
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from controller.config_kind import CheckedFile, ConfigKind
from drivers.by_hand.links import arrangement_of, check_links
from model.config.document import ConfigError, ConfigProblem, Document
from model.errors import InputError
from model.quantities import percent
from model.rig.rig import Rig
from model.rig.rig_balance import RigBalance
from model.rig.rig_file import example_rig_path, rig_of, with_base
from model.rig.rig_schema import rig_schema
from model.rig.rig_summary import summary_line
from model.rig.rig_warnings import (
    exciter_notes,
    gain_notes,
    mount_notes,
    plate_notes,
    resonance_notes,
)
from model.rig.sections import LimitsSection
from model.structure.statics import support_problem
from model.structure.surface import center_of_surface
from model.study.promise_cost import (
    ToleranceCosts,
    clock_cost,
    cost_rows,
    force_rows,
    uncertainty_costs,
)
from model.transients.excursions import excursion_notes

_LOST_DB = 0.1
"""Loss of contrast that is worth a warning."""

_SMALL_SPAN = 1 / 3
"""Share of the plate between ERAs below which there is a warning."""

_WEATHER_KEYS = ("temperature", "humidity")


def check_rig(document: Document) -> CheckedFile:
    """Check a rig and its amplifiers; raises ConfigError with all problems."""
    document = with_base(document)
    problems: list[ConfigProblem] = []
    rig: Rig | None = None
    channels = Counter[str]()
    limits = LimitsSection().build()
    try:
        rig = rig_of(document)
    except ConfigError as error:
        problems += error.problems
    else:
        channels = rig.channel_counts
        limits = rig.limits
        problems += _support_problems(document, rig)
    urls = _urls(document)
    link_errors, link_warnings = check_links(urls, channels=channels, limits=limits)
    reported_keys = [problem.key for problem in problems]
    link_problems = _link_problems(document, link_errors)
    problems += [problem for problem in link_problems if problem.key not in reported_keys]
    if rig is None or problems:
        raise ConfigError(document.source, problems)
    clock_line, clock_warnings, clock_data = clock_costs(rig, urls)
    summary = summary_line(rig)
    data: dict[str, Any] = {}
    balance = _balance(rig)
    if balance is not None:
        data["balance"] = balance.as_json()
        if balance.tips_over:
            summary = summary_line(rig, verdict="tips over")
        else:
            summary += f", {balance.phrase}"
    costs = _tolerance_costs(rig)
    warnings = _rig_warnings(rig, balance, costs, [*link_warnings, *clock_warnings])
    rows: list[str] = []
    if costs is not None:
        rows = [*cost_rows(rig.uncertainty, costs), *force_rows(rig, costs)]
        data["promised_contrast_db"] = costs.promised_db
        data["tolerance_costs_db"] = dict(costs.costs_db)
    return CheckedFile(summary + clock_line, warnings, data | clock_data, rows)


def _tolerance_costs(rig: Rig) -> ToleranceCosts | None:
    """Return the costs of a rig's tolerances; None for a rig without a table."""
    with contextlib.suppress(InputError):
        return uncertainty_costs(rig)
    return None


def _link_problems(document: Document, errors: Mapping[str, str]) -> Iterator[ConfigProblem]:
    """Yield the problems of amplifier URLs; errors: by the amplifier's name."""
    for name, message in errors.items():
        yield document.problem(("amplifiers", name, "url"), message)


def _rig_warnings(
    rig: Rig,
    balance: RigBalance | None,
    costs: ToleranceCosts | None,
    link_warnings: list[str],
) -> list[str]:
    """Return all warnings about a rig; link_warnings: about its wires and clocks."""
    warnings = [
        *exciter_notes(rig),
        *excursion_notes(rig),
        *resonance_notes(rig),
        *link_warnings,
        *gain_notes(rig),
        *plate_notes(rig),
        *_cost_notes(rig, costs),
        *mount_notes(rig),
    ]
    if balance is not None:
        warnings += balance.notes()
    warnings += _span_notes(rig)
    if rig.uncertainty_note:
        warnings.append(rig.uncertainty_note)
    return warnings


def _balance(rig: Rig) -> RigBalance | None:
    """Return how the plate rests on its supports; None for a surface that its modes hold."""
    surface = rig.plate.surface
    if surface is not None and center_of_surface(surface) is None:
        return None
    return RigBalance(rig)


def _support_problems(document: Document, rig: Rig) -> list[ConfigProblem]:
    """Return the problem of ERAs and feet that let the plate tip over, if any."""
    message = support_problem(rig.plate, rig.eras, loads=rig.masses)
    return [] if message is None else [document.problem(("eras",), message)]


def _cost_notes(rig: Rig, costs: ToleranceCosts | None) -> Iterator[str]:
    """Yield the contrast that loads and weather cost if the rig states them."""
    foreign_mass = rig.uncertainty.foreign_mass
    if foreign_mass:
        cause = f"uncertainty.foreign_mass: with {1e3 * foreign_mass:.3g} g anywhere on the plate"
        remedy = "list permanent loads under masses"
        yield from _uncertainty_note(costs, "foreign_mass", cause=cause, remedy=remedy)
    weather = rig.uncertainty.weather
    if weather:
        cause = (
            f"plate: temperature and humidity change its modulus by {100 * weather:.2g} %, one "
            "standard deviation;"
        )
        remedy = "narrow the range, or measure again when the season changes"
        yield from _uncertainty_note(costs, "weather", cause=cause, remedy=remedy)
        return
    plate_keys: Any = {}
    if rig.document is not None:
        plate_keys = rig.document.data.get("plate", {})
    if not plate_keys.keys().isdisjoint(_WEATHER_KEYS):
        yield (
            f"plate.{' and plate.'.join(_WEATHER_KEYS)}: nothing is known of how "
            f"{rig.plate.material.name} changes, so that promises do not count it; state "
            "uncertainty.weather, or give the material the name of a known one"
        )


def _uncertainty_note(
    costs: ToleranceCosts | None, key: str, *, cause: str, remedy: str
) -> Iterator[str]:
    """Yield the contrast that remains with one uncertainty of a rig."""
    if costs is None or key not in costs.costs_db:
        return
    kept = costs.promised_db
    exact = kept + costs.costs_db[key]
    yield f"{cause} a finger keeps {kept:.1f} of {exact:.1f} dB of contrast; {remedy}"


def _span_notes(rig: Rig) -> Iterator[str]:
    """Yield a warning if ERAs span a small part of the plate.

    Compares the promised contrast with the contrast of ERAs in the corners. ERAs in one line along
    a side give no warning.
    """
    positions = np.array([[era.x, era.y] for era in rig.eras])
    sides = np.array([rig.plate.length, rig.plate.width])
    span = np.ptp(positions, axis=0)
    share = float((span / sides).prod())
    if not 0 < share < _SMALL_SPAN:
        return
    corner_positions = sides * (positions - positions.min(axis=0)) / span
    positioned = zip(rig.eras, corner_positions.tolist(), strict=True)
    corner_eras = tuple(replace(era, x=x, y=y) for era, (x, y) in positioned)
    corner_rig = replace(rig, eras=corner_eras)
    exact_clocks = dict.fromkeys(rig.channel_counts, 0.0)
    with contextlib.suppress(InputError):  # the plate is too small for two fingers
        contrast_db = clock_cost(rig, exact_clocks).exact_db
        corner_db = clock_cost(corner_rig, exact_clocks).exact_db
        yield (
            f"eras: they span {percent(share)} of the plate; two vibrations are promised "
            f"{contrast_db:.1f} dB, with ERAs spread to its corners {corner_db:.1f} dB: check `at` "
            "of each after a change of plate.length or plate.width"
        )


def clock_costs(rig: Rig, urls: Mapping[str, str]) -> tuple[str, list[str], dict[str, Any]]:
    """Contrast that remains with the clocks of several amplifiers: summary, warnings and data.

    urls: by the amplifier's name. All three are empty for one amplifier, and for a plate without
    room for two fingers. The summary is empty if contrast is lost, which the warnings report.
    """
    arrangement = arrangement_of(urls, channels=rig.channel_counts, stated=rig.clock_errors)
    if arrangement is None:
        return "", [], {}
    errors = {**dict.fromkeys(rig.channel_counts, 0.0), **arrangement.errors}
    try:
        cost = clock_cost(rig, errors)
    except InputError:  # the plate is too small for two fingers
        return "", [], {}
    unsteered: list[str] = []
    error_us: dict[str, float | None] = {}
    largest_error = 0.0
    for name, error in errors.items():
        if math.isinf(error):
            unsteered.append(name)
            error_us[name] = None
        else:
            largest_error = max(largest_error, error)
            error_us[name] = round(1e6 * error, 1)
    summary = (
        f"{len(rig.eras)} ERAs on {len(errors)} amplifiers over {arrangement.lines}: clocks held "
        f"together to {1e6 * largest_error:.0f} us; two vibrations keep {cost.kept_db:.1f} of "
        f"{cost.exact_db:.1f} dB"
    )
    data = {
        "lines": arrangement.lines,
        "error_us": error_us,
        "exact_contrast_db": cost.exact_db,
        "kept_contrast_db": cost.kept_db,
    }
    if cost.exact_db - cost.kept_db < _LOST_DB:
        return f"; {summary}", [], {"clocks": data}
    if arrangement.remedy and not unsteered:
        summary += f"; {arrangement.remedy} gives all of it"
    warnings = [summary]
    for name in unsteered:
        warnings.append(
            f"amplifier {name} has no clock that can be steered: its ERAs play vibrations of their "
            "own"
        )
    return "", warnings, {"clocks": data}


def _urls(document: Document) -> dict[str, str]:
    """Return the URLs of amplifiers by name; invalid types are reported with the rig's keys."""
    amplifiers = document.data.get("amplifiers")
    if not isinstance(amplifiers, dict):
        return {}
    urls = {}
    for name, amplifier in amplifiers.items():
        url = amplifier.get("url") if isinstance(amplifier, dict) else None
        if isinstance(url, str):
            urls[name] = whole_url(url, document.source, str(name))
    return urls


def whole_url(url: str, rig_file: str | Path, amplifier: str) -> str:
    """The URL of an amplifier; `sim://` alone becomes a simulated one over this rig's plate."""
    if url != "sim://":
        return url
    return f"sim://{quote(os.fsencode(rig_file))}?amplifier={quote(amplifier)}"


RIG = ConfigKind(
    "A rig of era-haptics",
    recognises=lambda document: not {"plate", "surface"}.isdisjoint(document.data),
    check=check_rig,
    example_file=example_rig_path(),
    keys=rig_schema,
)
