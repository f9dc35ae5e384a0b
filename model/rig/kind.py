"""Rig files as a kind of configuration of `era config`.

Its amplifiers are checked by the package that knows wires. Warnings say what a rig does not know or
leaves out.
"""

import cmath
import contextlib
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from pkgutil import resolve_name
from typing import Any
from urllib.parse import quote

import numpy as np

from model.config.document import ConfigError, ConfigProblem, Document
from model.config.file_kinds import CheckedFile, ConfigKind
from model.errors import InputError
from model.quantities import percent
from model.rig.era_section import STIFF_MOUNT
from model.rig.exciter_checks import exciter_notes
from model.rig.file import example_rig_path, rig_of
from model.rig.parts import limits_of
from model.rig.rig import Rig
from model.rig.sections import LimitsSection, RigSection
from model.structure.attachments import Era, Source
from model.structure.feet_and_frames import DEFAULT_POINTS, least_points
from model.structure.laminate_section import slide_frequency
from model.structure.support import support_problem

# Modes are within 3 % of the direct solution up to half of where layers slide by themselves, off
# by as much as there is around it (faces of 0.5 mm aluminium on 50 mm of E 0.1 to 10 MPa).
_FAR_FROM_SLIDING = 2.0


def _check(document: Document) -> CheckedFile:
    """Check a rig and its amplifiers; return its values in a line, to show unlikely ones."""
    problems: list[ConfigProblem] = []
    rig = None
    try:
        rig = rig_of(document)
    except ConfigError as error:
        problems += error.problems
    urls = _urls(document)
    counts = rig.channel_counts if rig else Counter[str]()
    limits = rig.limits if rig else limits_of(LimitsSection())
    wrong, warnings = resolve_name(_CHECK)(urls, channels=counts, limits=limits)
    if rig is not None:
        support = support_problem(rig.plate, rig.eras, loads=rig.masses)
        problems += [] if support is None else [document.problem(("eras",), support)]
    known = {problem.key for problem in problems}
    of_urls = [document.problem(("amplifiers", name, "url"), what) for name, what in wrong.items()]
    problems += [problem for problem in of_urls if problem.key not in known]
    if rig is None or problems:
        raise ConfigError(document.source, problems)
    note = rig.uncertainty_note
    line, lost, more = clock_costs(rig, urls)
    warnings = [*exciter_notes(rig), *warnings]
    costs = [
        *(*lost, *gain_notes(rig), *_plate_notes(rig)),
        *(*_mount_notes(rig), *_span_notes(rig)),
    ]
    return CheckedFile(_summary(rig) + line, [*warnings, *costs, *([note] if note else [])], more)


RIG = ConfigKind(
    "A rig of era-haptics",
    recognises=lambda document: "plate" in document.data,
    check=_check,
    example_file=example_rig_path(),
    keys=RigSection.model_json_schema,
)


_THICK = 0.02  # m; of one material


def _plate_notes(rig: Rig) -> Iterator[str]:
    """Yield warnings of a plate in the wrong unit, and of what air and soft layers cost."""
    plate, low, high = rig.plate, rig.limits.frequency_min, rig.limits.frequency_max
    if rig.laminate is None and plate.thickness > _THICK:
        yield (
            f"plate.thickness: {1e3 * plate.thickness:g} mm is thick for a plate that is to be "
            "felt; check its unit, mm or cm"
        )
    if plate.air_gap is not None and (error := plate.air_gap.coupling_error(low)):
        off = "half of it or more: take no answer from it" if error > 0.1 else f"{100 * error:g} %"
        yield (
            f"plate.air_gap: in {1e3 * plate.air_gap.depth:g} mm friction of the air couples the "
            f"modes at {low:g} Hz, which is left out: the response may be off by {off}"
        )
    slide = math.inf if plate.laminate is None else slide_frequency(plate.laminate, high)
    if high >= slide / _FAR_FROM_SLIDING:
        yield (
            f"plate.layers: at {slide:.3g} Hz they slide to and fro by themselves, and change "
            "their thickness little above, which is left out: take no answer from it above "
            f"{slide / _FAR_FROM_SLIDING:.3g} Hz"
        )


_SMALL_SPAN = 1 / 3  # of the plate


def _span_notes(rig: Rig) -> Iterator[str]:
    """Yield a warning where ERAs span a small part of the plate, with what its corners promise.

    None for ERAs in one line along a side.
    """
    places = np.array([[era.x, era.y] for era in rig.eras])
    sides = np.array([rig.plate.length, rig.plate.width])
    span = np.ptp(places, axis=0)
    share = float((span / sides).prod())
    if not 0 < share < _SMALL_SPAN:
        return
    apart = (sides * (places - places.min(axis=0)) / span).tolist()
    eras = tuple(replace(era, x=x, y=y) for era, (x, y) in zip(rig.eras, apart, strict=True))
    exact = dict.fromkeys(rig.channel_counts, 0.0)
    with contextlib.suppress(InputError):  # no place for two fingers
        here, there = (
            resolve_name(_COST)(each, exact).exact_db for each in (rig, replace(rig, eras=eras))
        )
        yield (
            f"eras: they span {percent(share)} of the plate; two contents are promised {here:.1f} "
            f"dB, with ERAs spread to its corners {there:.1f} dB: check `at` of each after a "
            "change of plate.length or plate.width"
        )


def _mount_notes(rig: Rig) -> Iterator[str]:
    """Yield what stiff mounts cost that are points, and few points of an edge with many waves."""
    decade = math.log(10) / (2 * math.pi * rig.plate.shear_rigidity)
    mounts = {era.name: era.support for era in rig.eras} | dict(
        zip(rig.supports, rig.masses[len(rig.masses) - len(rig.supports) :], strict=True)
    )
    for name, mount in mounts.items():
        if mount.stiffness >= STIFF_MOUNT and not mount.foot:
            yield (
                f"eras.{name}.foot: the dent under a point of {mount.stiffness:g} N/m has no "
                f"limit, a tenfold smaller one adds at least {100 * decade * mount.stiffness:.1f} "
                "% of the mount's own compliance; give its radius, and see `era plate convergence`"
            )
    high = rig.limits.frequency_max
    needed = least_points(rig.plate, high)
    for kind in ("masses", "supports"):
        for name, keys in _attached(rig, kind).items():
            if "along" in keys and (count := keys.get("points", DEFAULT_POINTS)) < needed:
                yield (
                    f"{kind}.{name}.points: {count} on each edge are few at {high:g} Hz; give "
                    f"{needed}"
                )


def _summary(rig: Rig) -> str:
    plate, laminate = rig.plate, rig.laminate
    thickness = plate.thickness if laminate is None else laminate.thickness
    sizes = " x ".join(f"{1e3 * size:g}" for size in (plate.length, plate.width, thickness))
    made_of = plate.material.name
    if laminate is not None and len(laminate.layers) > 1:
        made_of = f"laminate ({', '.join(layer.material.name for layer in laminate.layers)})"
    parts = [
        f"{sizes} mm of {made_of}",
        f"mesh {rig.mesh}",
        f"ERAs {', '.join(era.name for era in rig.eras)}",
    ]
    gap = plate.air_gap
    if gap is not None:
        edges = "sealed" if gap.closed else "open"
        parts.insert(1, f"{1e3 * gap.depth:g} mm of air behind it, {edges} at the edges")
    if feet := [*_attached(rig, "supports"), *rig.supports]:
        parts.append(f"supported without being driven by {', '.join(feet)}")
    if carried := sum(mass.mass for mass in rig.masses):
        parts.append(f"carries {1e3 * carried:g} g")
    return f"good: {', '.join(parts)}"


def _attached(rig: Rig, kind: str) -> dict[str, Any]:
    """Masses or supports of the rig's file."""
    keys: Any = {} if rig.document is None else rig.document.data.get(kind)
    return dict(keys or {})


_MAX_ANGLE = math.radians(20.5)  # between two rows


def gain_notes(rig: Rig) -> list[str]:
    """Warnings: ERAs behind an output whose gains are missing, and each with rows too far apart.

    What others than ERAs do behind an output is known without gains.
    """
    behind = [era for era in rig.eras if rig.wiring[era.name].amplifier in rig.outputs]
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    names = [era.name for era in behind if isinstance(era, Era) and not era.gains]
    notes = []
    if names:
        notes.append(
            f"gains of {', '.join(names)}: missing behind an output, so that their motion is a "
            "guess, a stroke by full level at every frequency; measure the plate and calibrate the "
            "rig"
        )
    return [*notes, *(text for era in behind for text in _notes(era, low, high))]


def _notes(era: Source, low: float, high: float) -> list[str]:
    played = [each for each in pairwise(era.gains) if each[0][0] < high and each[1][0] > low]
    turns = {
        abs(cmath.phase(cmath.rect(1, other[2] - one[2]))): (one[0], other[0])
        for one, other in played
    }
    angle = max(turns, default=0.0)
    if angle <= _MAX_ANGLE:
        return []
    first, last = turns[angle]
    return [
        f"eras.{era.name}.gains: phases differ by {math.degrees(angle):.0f} degrees between "
        f"{first:g} and {last:g} Hz, at most 20 are interpolated well; measure between them"
    ]


_ARRANGEMENT = "drivers.by_hand.rig_check:arrangement_of"
_COST = "model.study.clock_costs:clock_cost"
_LOST_DB = 0.1  # contrast that is worth a warning


def clock_costs(rig: Rig, urls: Mapping[str, str]) -> tuple[str, list[str], dict[str, Any]]:
    """What the clocks of several amplifiers leave: to the line of a good rig, warnings, and data.

    urls: by the amplifier's name. Nothing of one alone.
    """
    arrangement = resolve_name(_ARRANGEMENT)(
        urls, channels=rig.channel_counts, stated=rig.clock_errors
    )
    if arrangement is None:
        return "", [], {}
    errors = dict.fromkeys(rig.channel_counts, 0.0) | arrangement.errors
    try:
        cost = resolve_name(_COST)(rig, errors)
    except InputError:  # no place for two fingers
        return "", [], {}
    alone = [name for name, each in errors.items() if math.isinf(each)]
    us = 1e6 * max((each for each in errors.values() if math.isfinite(each)), default=0.0)
    said = (
        f"{len(rig.eras)} ERAs on {len(errors)} amplifiers over {arrangement.lines}: clocks held "
        f"together to {us:.0f} us; two contents keep {cost.kept_db:.1f} of {cost.exact_db:.1f} dB"
    )
    data = {
        "lines": arrangement.lines,
        "error_us": {
            name: None if name in alone else round(1e6 * each, 1) for name, each in errors.items()
        },
        "exact_contrast_db": cost.exact_db,
        "kept_contrast_db": cost.kept_db,
    }
    if cost.exact_db - cost.kept_db < _LOST_DB:
        return f"; {said}", [], {"clocks": data}
    remedy = f"; {arrangement.remedy} gives all of it" if arrangement.remedy and not alone else ""
    unsteered = [
        f"amplifier {name} has no clock that can be steered: its ERAs play contents of their own"
        for name in alone
    ]
    return "", [said + remedy, *unsteered], {"clocks": data}


_CHECK = "drivers.by_hand.rig_check:check_links"
"""By name: this package does not import the one beside it.

Of URLs by the amplifier's name, numbers of channels that are wired, and the rig's limits; it gives
errors by the amplifier's name, and warnings, and opens none.
"""


def _urls(document: Document) -> dict[str, str]:
    """All URLs that are text."""
    amplifiers = document.data.get("amplifiers")
    return {
        name: whole_url(url, document.source, str(name))
        for name, amplifier in (amplifiers.items() if isinstance(amplifiers, dict) else ())
        if isinstance(amplifier, dict) and isinstance(url := amplifier.get("url"), str)
    }


def whole_url(url: str, rig_file: str | Path, amplifier: str) -> str:
    """The URL of an amplifier; `sim://` alone becomes a simulated one over this rig's plate."""
    if url != "sim://":
        return url
    return f"sim://{quote(os.fsencode(rig_file))}?amplifier={quote(amplifier)}"
