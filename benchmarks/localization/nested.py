"""What live answers lose to those for a higher level, and to those of a smaller drive mode.

    python -m benchmarks.localization.nested [--sets 12]

The paper's plate, known as well as stated; one, two and three quiet fingers, levels from 0 to 60
dB SL in steps of 5. Counted are pairs of answers, both at their level on nine of ten plates, of
which the one to the higher level, or of the contained mode, promises more than 0.1 dB more felt
contrast; and the most that it does.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.localization.cases import contact_sets, paper_table, question_of
from benchmarks.setting import use_one_thread
from model.arrays import FloatArray
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.rig.uncertainty import Uncertainty
from model.table.table import LocalizationTable

LEVELS = np.arange(0.0, 60.1, 5.0)
RIGS = {
    "nothing uncertain": Uncertainty.none(),
    "drives 1 %, 1°": Uncertainty(0.01, 1.0, 0.0, 0.0, 1.0, 0.0),
    "default": Uncertainty(),
}
TOLERANCE = 0.1  # dB


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.localization.nested")
    parser.add_argument("--sets", type=int, default=12)
    sets = parser.parse_args().sets
    use_one_thread()
    for name, uncertainty in RIGS.items():
        table = replace(paper_table(), uncertainty=uncertainty)
        found = [_answers(table, places) for places in _fingers(sets)]
        for mode in DRIVE_MODES:
            steps = np.concatenate([np.diff(each[mode]) for each in found])
            print(f"{name}, {mode}: higher level {_counted(steps)}")
        excess = np.concatenate([each["switched"] - each["phased"] for each in found])
        print(f"{name}, phased: switched {_counted(excess)}")


def _fingers(sets: int) -> Iterator[FloatArray]:
    for quiet in (1, 2, 3):
        yield from contact_sets(sets, fingers=1 + quiet, rng=np.random.default_rng(quiet))


def _answers(table: LocalizationTable, places: FloatArray) -> dict[str, FloatArray]:
    """Promised contrast [dB] by drive mode at all levels; NaN where the level is not reached."""
    found = {}
    for mode in DRIVE_MODES:
        promised = np.full(len(LEVELS), np.nan)
        for number, level in enumerate(LEVELS.tolist()):
            try:
                pattern = table.query(question_of(places, level_db_sl=level, drive_mode=mode))
            except InputError:
                break
            if (pattern.robust_level_db_sl or 0.0) >= level - 1e-3:
                promised[number] = pattern.robust_felt_contrast_db
        found[mode] = promised
    return found


def _counted(excess: FloatArray) -> str:
    known = excess[~np.isnan(excess)]
    more = known[known > TOLERANCE]
    return f"{len(more)} of {len(known)}, at most {more.max(initial=0.0):.1f} dB"


if __name__ == "__main__":
    main()
