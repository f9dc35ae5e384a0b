"""Promises of answers on plates that the search has not seen, by the cases of `promises.yaml`."""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model.answer.answer import Answer
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import FloatArray
from model.ensemble.draws import ClockErrors
from model.rig.rig import Uncertainty
from model.rig.rig_file import load_rig
from model.study.verification import draw_plates
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from plates import SMALL_TABLE_HZ, Realised, contact_sets, realised, smooth_rig
from yaml_files import read_yaml

WEEKEND = Path(__file__).parents[3] / "examples" / "weekend" / "rig.yaml"
CASES: dict[str, dict[str, Any]] = {
    case["promised"]: case for case in read_yaml(Path(__file__).with_name("promises.yaml"))
}
AMPLIFIERS = (0, 1, 0, 1)  # of the ERAs


@cache
def table_of(name: str) -> LocalizationTable:
    """The table of a case, which knows its rig as well as the plates do."""
    case = CASES[name]
    rig = smooth_rig() if case["plate"] == "paper" else load_rig(WEEKEND)
    if "rig" in case:
        rig = rig.replaced(**case["rig"])
    if "known" in case:
        rig = replace(rig, uncertainty=replace(Uncertainty.none(), **case["known"]))
    rig = replace(rig, promised_thresholds=tuple(case.get("by", rig.promised_thresholds)))
    frequencies = SMALL_TABLE_HZ
    if "hertz" in case:
        first, last, step = case["hertz"]
        frequencies = np.arange(first, last + 1, step, dtype=float)
    return build_table(rig, frequencies=frequencies, drive_mode=case.get("mode", "phased"))


def believing(table: LocalizationTable, case: Mapping[str, Any]) -> LocalizationTable:
    """The table that promises, with what it takes for known."""
    believed = {"late": case.get("late", 0), **case.get("believed", {})}
    late = believed.pop("late")
    table = replace(table, uncertainty=replace(table.uncertainty, **believed))
    errors = (math.inf if late == "anyhow" else late,) * 2
    return table.with_clocks(ClockErrors(AMPLIFIERS, errors)) if late else table


def delays(case: Mapping[str, Any], rng: np.random.Generator) -> FloatArray | None:
    """Delays (d, eras) of the drives [s], None where there are none."""
    if "late" not in case:
        return None
    shape, late = (case["draws"]["plates"], 2), case["late"]
    drawn = rng.uniform(0, 1, shape) if late == "anyhow" else rng.normal(0, late, shape)
    return np.asarray(drawn[:, list(AMPLIFIERS)])


def shares(found: Answer, by_set: Sequence[Realised]) -> dict[str, float]:
    """Shares of plates that keep each promise, of each finger by the set that keeps it least."""
    count = sum(each.layer is not None for each in found.fingers)
    promised = {
        key: np.array([getattr(each, key) for each in found.fingers], dtype=float)[:, None]
        for key in ("promised_level_db_sl", "promised_contrast_db", "foreign_level_db_sl")
    }
    kept = {
        "worst": [each.contrast.min(axis=0)[None] >= found.promised_worst_db for each in by_set],
        "level": [(each.own >= promised["promised_level_db_sl"])[:count] for each in by_set],
        "contrast": [
            (each.contrast >= promised["promised_contrast_db"])[:count] for each in by_set
        ],
        "foreign": [each.foreign <= promised["foreign_level_db_sl"] for each in by_set],
    }
    return {
        name: float(np.min(np.mean(each, axis=2), axis=0).mean()) for name, each in kept.items()
    }


def judge(name: str) -> None:
    """Answer each set of fingers, solve the plates drawn for it, and count what is kept."""
    case, table = CASES[name], table_of(name)
    asked, draws = believing(table, case), case["draws"]
    stimuli, quiet = [Stimulus(**keys) for keys in case["contents"]], case.get("quiet", [0])
    sets = contact_sets(
        draws["sets"], fingers=len(stimuli) + max(quiet), seed=draws["seed"], plate=table.plate
    )
    kept, off, modulated = defaultdict(list), list[float](), list[bool]()
    for seed, (places, beside) in enumerate(zip(sets, cycle(quiet), strict=False)):
        fingers = [Finger(at, each) for at, each in zip(places, stimuli, strict=False)]
        others = places[len(stimuli) :][:beside]
        found = answer(
            asked, fingers, quiet=others, drive_mode=table.drive_mode, min_contrast_db=-99.0
        )
        modulated.append(any(each.side_bands for each in found.layers))
        rng, contacts = np.random.default_rng(seed), len(fingers) + len(others)
        plates = draw_plates(
            rng, table.uncertainty, of=table, count=draws["plates"], contact_count=contacts
        )
        late = delays(case, rng)
        by_set = [
            realised(table, found, plates, threshold=threshold, late=late)
            for threshold in case.get("judged", [table.threshold])
        ]
        for promise, share in shares(found, by_set).items():
            kept[promise].append(share)
        worst = by_set[0].contrast.min(axis=0)
        if "tenth" in case:
            assert found.promised_worst_db == pytest.approx(
                np.percentile(worst, 10), abs=case["tenth"]
            )
        off.append(np.median(worst) - (found.fingers[0].median_contrast_db or 0.0))
    for promise, (least, most) in case.get("kept", {}).items():
        assert least <= np.mean(kept[promise]) <= most, promise
    assert np.mean(modulated) >= 0.5 * any(each.modulation_hz for each in stimuli)
    assert abs(np.mean(off)) <= case.get("median", math.inf)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.long if CASES[n].get("long") else ()) for n in CASES],
)
def test_promises_are_kept_by_nine_of_ten_plates(name: str) -> None:
    """Each share is within the bounds of its case, on plates solved exactly."""
    judge(name)


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.get("numpy")])
def test_promises_by_numpy_are_kept_too(name: str, without_kernels: Callable[[], None]) -> None:
    """The same where there is no compiler."""
    without_kernels()
    judge(name)
