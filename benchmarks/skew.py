"""What it costs that two amplifiers under one plate do not start together, by frequency.

    python -m benchmarks.skew [--sets 100]

Two tables. What two equal halves that cancel leave if one is late, -20 log10 |2 sin(pi f t)|; and
the median contrast of the paper's plate between one target and one quiet finger at random places,
the two ERAs of the far edge late, with what is lost in brackets.
"""

import argparse
import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from benchmarks.setting import RIG, random_contacts, use_one_thread
from model.arrays import FloatArray
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import contrast_db
from model.rig.file import load_rig
from model.table.build import build_table
from model.table.question import MIN_LEVEL_DB_SL, Question
from model.table.table import LocalizationTable
from model.vibration.excitation import Excitation

FREQUENCIES = (60.0, 100.0, 250.0, 500.0)  # Hz
SKEWS = (1e-5, 1e-4, 5e-4, 1e-3)  # s
LATE = ("NE", "NW")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.skew")
    parser.add_argument("--sets", type=int, default=100)
    sets = parser.parse_args().sets
    use_one_thread()
    rig = load_rig(RIG)
    head = "| skew | " + " | ".join(f"{frequency:.0f} Hz" for frequency in FREQUENCIES) + " |"
    rule = "|---" * (1 + len(FREQUENCIES)) + "|"
    print(head, rule, sep="\n")
    for skew in SKEWS:
        print(_row(_text(skew), (f"{cancellation(f, skew):.0f} dB" for f in FREQUENCIES)))
    columns = [_contrasts(build_table(rig, frequencies=np.array([f])), sets) for f in FREQUENCIES]
    print("", head, rule, sep="\n")
    print(_row("none", (f"{column[0]:.1f} dB" for column in columns)))
    for number, skew in enumerate(SKEWS, start=1):
        cells = (f"{one[number]:.1f} dB ({one[number] - one[0]:+.1f})" for one in columns)
        print(_row(_text(skew), cells))


def cancellation(frequency: float, skew: float) -> float:
    """How far two equal halves cancel [dB] if one is late by a skew [s]; at least 0."""
    return max(0.0, -20 * math.log10(abs(2 * math.sin(math.pi * frequency * skew))))


def _contrasts(table: LocalizationTable, sets: int) -> FloatArray:
    """Median contrast [dB] without a skew and with each."""
    rng = np.random.default_rng(1)
    rows = []
    for _ in range(sets):
        target, quiet = map(tuple, random_contacts(rng, 2, (table.plate.length, table.plate.width)))
        question = Question((target,), (quiet,), level_db_sl=MIN_LEVEL_DB_SL)
        excitation = table.query(question).excitation
        rows.append([_contrast(table, excitation, question, skew) for skew in (0.0, *SKEWS)])
    return np.asarray(np.median(rows, axis=0))


def _contrast(
    table: LocalizationTable, excitation: Excitation, question: Question, skew: float
) -> float:
    late = {
        name: replace(tone, phase=tone.phase - 2 * math.pi * tone.frequency * skew)
        for name, tone in excitation.items()
        if name in LATE
    }
    felt = [
        table.amplitudes(
            {**excitation, **late},
            fingertip_points(*place, table.plate),
            contacts=question.contacts,
        )[1].sum(axis=0)
        for place in question.contacts
    ]
    weights = fingertip_weights(*question.targets[0], table.plate)
    return float(contrast_db([felt[0]], felt[1], [weights]))


def _text(skew: float) -> str:
    return f"{skew * 1e6:.0f} µs" if skew < 1e-4 else f"{skew * 1e3:g} ms"


def _row(name: str, cells: Iterable[str]) -> str:
    return f"| {name} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
