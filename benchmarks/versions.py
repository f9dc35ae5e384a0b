"""Contrast of answers for one finger, of a checkout against those of an earlier one.

    python -m benchmarks.versions answer FILE [--sets N]
    python -m benchmarks.versions compare BEFORE AFTER [--report]

`answer` asks the tables of the checkout in which it runs, on the examples with four, eight, twelve
and sixteen ERAs, for N sets each with one, two and three quiet fingers, 40 to 320 Hz in steps of
10, 20 dB SL, and writes the patterns; this file alone runs in older checkouts, too. `compare` plays
both files on the same plates. Those of the examples' own uncertainty are 200 that are solved
exactly in the modes of the table; with drives known to 1 % and 1 degree and nothing else uncertain
they are those of `benchmarks.realised`. Printed are differences [dB] of the felt contrast that nine
of ten plates give: mean and median over sets. With --report, the page
docs/measured/contrast-benchmark.md is written as well.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.realised import PAGE, realised
from benchmarks.setting import RIG, random_contacts, write_parts
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.finger import decibels
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.study.verification import draw_plates, felt_on
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.vibration import Tone

PLATES = ("paper_plate", "eight_eras", "car_display", "table")
UNCERTAINTIES = ("as in the file", "drives known to 1 %")
QUIET = (1, 2, 3)
SEED, DRAWS = 31, 200
MARGIN = 0.013  # m; so that no edge cuts a fingertip


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.versions")
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("answer", help="write the answers of this checkout")
    one.add_argument("file", type=Path)
    one.add_argument("--sets", type=int, default=84, help="for each number of quiet fingers")
    two = commands.add_parser("compare", help="play the answers of two checkouts")
    two.add_argument("before", type=Path)
    two.add_argument("after", type=Path)
    two.add_argument("--report", action="store_true")
    options = parser.parse_args()
    if options.command == "answer":
        options.file.write_text(json.dumps(_answers(options.sets), indent=1) + "\n")
        return

    text = _compared(json.loads(options.before.read_text()), json.loads(options.after.read_text()))
    if options.report:
        run = "`python -m benchmarks.versions compare BEFORE AFTER --report`"
        write_parts(PAGE, {"versions": f"Printed by {run}.\n\n{text}"})


def _tables() -> Iterator[tuple[str, str, Rig, LocalizationTable]]:
    """Names of plates, their uncertainty in words, rigs with it, and their tables."""
    known = replace(Uncertainty.none(), gain=0.01, phase_deg=1.0)
    for name in PLATES:
        rig = load_rig(RIG.parent / f"{name}.yaml")
        for words, uncertainty in zip(UNCERTAINTIES, (rig.uncertainty, known), strict=True):
            rig = replace(rig, uncertainty=uncertainty)
            frequencies = np.arange(40.0, 321.0, 10.0)
            yield name, words, rig, build_table(rig, frequencies=frequencies, drive_mode="phased")


def _placement(rig: Rig, quiet: int, number: int) -> Placement:
    """The fingers of a set."""
    rng = np.random.default_rng([SEED, quiet, number])
    size = (rig.plate.length, rig.plate.width)
    target, *others = random_contacts(rng, 1 + quiet, size, margin=MARGIN).tolist()
    return Placement((tuple(target),), tuple(map(tuple, others)))


def _answers(sets: int) -> dict[str, list[dict[str, list[float]]]]:
    """Patterns of every table and number of quiet fingers: by ERA [Hz], [m] and [rad]."""
    found = {}
    for name, words, rig, table in _tables():
        for quiet in QUIET:
            patterns = [
                query(table, _placement(rig, quiet, number)).layers[0] for number in range(sets)
            ]
            found[f"{name}, {words}, {quiet}"] = [
                {
                    era: [tone.frequency, tone.amplitude, tone.phase]
                    for era, tone in pattern.excitation.items()
                }
                for pattern in patterns
            ]
        print(f"{name}, {words}", flush=True)
    return found


def _compared(before: dict[str, Any], after: dict[str, Any]) -> str:
    """A table of differences; its lines are printed as they come."""
    quiet_fingers = " / ".join(map(str, QUIET))
    lines = [
        f"| plate, uncertainty | contrast before, {quiet_fingers} quiet | mean difference | "
        "median difference | lower by more than 1 dB, higher | least level before, after |",
        "|---|---|---|---|---|---|",
    ]
    for name, words, rig, table in _tables():
        medians, means, middles, levels = [], [], [], []
        all_differences = []
        for quiet in QUIET:
            key = f"{name}, {words}, {quiet}"
            scores = np.array(
                [
                    [_score(table, rig, quiet, number, each) for number, each in enumerate(found)]
                    for found in (before[key], after[key])
                ]
            )
            differences = scores[1, :, 0] - scores[0, :, 0]
            medians.append(f"{np.median(scores[0, :, 0]):.1f}")
            means.append(f"{differences.mean():+.2f}")
            middles.append(f"{np.median(differences):+.2f}")
            levels.append(scores[:, :, 1].min(axis=1))
            all_differences.extend(differences)
        change = np.array(all_differences)
        least = np.min(levels, axis=0)
        lines.append(
            f"| `{name}`, {words} | {' / '.join(medians)} | {' / '.join(means)} | "
            f"{' / '.join(middles)} | {100 * (change < -1).mean():.0f} %, "
            f"{100 * (change > 1).mean():.0f} % | {least[0]:.1f}, {least[1]:.1f} |"
        )
        print(lines[-1], flush=True)
    return "\n".join(lines)


def _score(
    table: LocalizationTable, rig: Rig, quiet: int, number: int, tones: dict[str, list[float]]
) -> tuple[float, float]:
    """Felt contrast [dB] and level [dB SL] that nine of ten plates give."""
    question = _placement(rig, quiet, number)
    excitation = {era: Tone(*tone) for era, tone in tones.items()}
    if not rig.uncertainty.thickness:  # other plates of it would each take a solution
        contrast, level = realised(rig, question, excitation, number)
    else:
        plates = draw_plates(
            np.random.default_rng([SEED, quiet, number]),
            rig.uncertainty,
            count=DRAWS,
            of=rig,
            contact_count=1 + quiet,
        )
        felt_level, felt_contrast = felt_on(table, question, excitation, plates)
        assert felt_contrast is not None
        contrast, level = decibels(felt_contrast), decibels(felt_level)
    return float(np.percentile(contrast, 10)), float(np.percentile(level, 10))


if __name__ == "__main__":
    main()
