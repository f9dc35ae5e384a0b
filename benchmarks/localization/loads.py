"""What it is worth to know how hard the fingers press, and what it costs.

    python -m benchmarks.localization.loads [--sets 60]

On the paper's plate, mode phased: every contact presses as hard as a panel may report, or as
lightly, at random. Answers that know it and answers that take the rig's fingertip, judged on exact
plates within the rig's uncertainty, but under these fingers: contrast that nine of ten plates keep
and level of the target at nine of ten, median and the worse tenth over the sets; and the share of
plates that keep the promise. Then the processor time of an answer.
"""

import argparse
import math
import time
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.localization.cases import contact_sets, paper_table, question_of
from benchmarks.setting import use_one_thread
from controller.sources.contact_load import MAX_REPORTED, MIN_CHANGE, MIN_REPORTED
from model.ensemble.measures import percentile
from model.finger.perception import decibels
from model.table.exact_plates import draw_plates, felt_on
from model.table.question import Question

PLATES = 100
REPEATED = 5
QUIET = (1, 2, 3)
BOUNDS = (MIN_REPORTED, MAX_REPORTED)
STEP = (1 / MIN_CHANGE, MIN_CHANGE)


@dataclass(frozen=True)
class Found:
    """An answer on exact plates: contrast and level that nine of ten give, share that keeps."""

    contrast_db: float
    level_db_sl: float
    kept: float


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.localization.loads")
    parser.add_argument("--sets", type=int, default=60)
    sets = parser.parse_args().sets
    use_one_thread()
    print(f"{sets} sets each: contrast / dB, level / dB SL, median (worse tenth); kept")
    for name, pair, std in (
        ("0.4 or 2.5", BOUNDS, None),
        ("0.4 or 2.5, else sure", BOUNDS, 0.1),
        ("within a step", STEP, None),
    ):
        for quiet in QUIET:
            for known in (False, True):
                row = _row(sets, quiet, pair, std=std, known=known)
                print(f"{name}, {quiet} quiet, {'known' if known else 'not known'}: {row}")
    for quiet in (1, 3, 9):
        without, loaded = _times(sets, quiet)
        print(f"{quiet} quiet: {1e3 * without:.2f} ms, with loads {1e3 * loaded:.2f} ms")


def _questions(sets: int, quiet: int, pair: tuple[float, float]) -> list[Question]:
    rng = np.random.default_rng(quiet)
    return [
        replace(
            question_of(places, drive_mode="phased", level_db_sl=15.0),
            loads=tuple(rng.choice(pair, 1 + quiet).tolist()),
        )
        for places in contact_sets(sets, fingers=1 + quiet, rng=rng)
    ]


def _row(
    sets: int, quiet: int, pair: tuple[float, float], *, std: float | None, known: bool
) -> str:
    found = [_judged(each, std=std, known=known) for each in _questions(sets, quiet, pair)]
    contrast = np.array([each.contrast_db for each in found])
    level = np.array([each.level_db_sl for each in found])
    parts = (
        f"{np.median(each):5.1f} ({np.percentile(each, 10):5.1f})" for each in (contrast, level)
    )
    return ", ".join([*parts, f"{100 * np.mean([each.kept for each in found]):.0f} %"])


def _judged(question: Question, *, std: float | None, known: bool) -> Found:
    """std: of the logarithm of the load, None for the rig's own."""
    table = paper_table()
    if std is not None:
        table = replace(table, uncertainty=replace(table.uncertainty, fingertip=std))
    pattern = table.query(question if known else replace(question, loads=()))
    plates = draw_plates(
        np.random.default_rng(1),
        table.uncertainty,
        count=PLATES,
        era_count=len(table.eras),
        contact_count=len(question.contacts),
    )
    felt = felt_on(table, question, pattern.excitation, plates)
    if felt.contrast is None or pattern.robust_felt_contrast_db is None:
        raise AssertionError("a question with quiet fingers has contrasts")
    contrast = decibels(felt.contrast.felt[0])
    return Found(
        float(percentile(contrast)),
        float(decibels(percentile(felt.level[0]))),
        float((contrast >= pattern.robust_felt_contrast_db).mean()),
    )


def _times(sets: int, quiet: int) -> tuple[float, float]:
    """Processor time [s] of an answer without and with loads: fastest of some, median over sets."""
    table, found = paper_table(), []
    for question in _questions(sets, quiet, BOUNDS):
        fastest = [math.inf, math.inf]
        for _ in range(REPEATED):  # in turn, so that a busy machine slows both
            for number, asked in enumerate((replace(question, loads=()), question)):
                started = time.process_time()
                table.query(asked)
                fastest[number] = min(fastest[number], time.process_time() - started)
        found.append(fastest)
    without, loaded = np.median(found, axis=0).tolist()
    return without, loaded


if __name__ == "__main__":
    main()
