"""Contrast and time of answers to several contents, by number of ERAs.

    python -m benchmarks.contents [--only RIG ...] [--sets N] [--fingers K] [--modulation HZ]

The examples with four, eight, twelve and sixteen ERAs, 40 to 320 Hz in steps of 10, fingers 5 cm
apart (8 cm on the table) with contents of 20 dB SL, 20 Hz apart; `identified`: with an uncertainty
as after `era rig identify`. For every number of contents and quiet fingers the worst finger that
nine of ten plates promise: median over the sets (and their worst tenth); share of exactly solved
plates that keep the promise (`model.table.exact_plates`); processor time of an answer on one
thread, median. With --fingers so many fingers in all, 3 cm apart, for the times. With --modulation
contents 30 Hz apart, of which the first comes and goes so often: what that costs the worst finger
where it is served, median over the sets (and the most).
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.setting import random_contacts, use_one_thread

if TYPE_CHECKING:
    from model.arrays import FloatArray
    from model.table.request import Answer
    from model.table.table import LocalizationTable

EXAMPLES = Path(__file__).parents[1] / "examples"
PLATES = ("paper_plate", "eight_eras", "car_display", "table")
SETS = ((1, 1), (2, 0), (3, 0), (4, 0), (2, 1), (2, 2))
HELD_OUT = 100  # plates for each set


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.contents",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", metavar="RIG", help="default: all four")
    parser.add_argument("--sets", type=int, default=24)
    parser.add_argument("--fingers", type=int, metavar="K", help="in all, one to four contents")
    parser.add_argument("--modulation", type=float, metavar="HZ", help="of the first content")
    options = parser.parse_args()
    use_one_thread()
    import numpy as np

    from model.rig.file import load_rig
    from model.rig.uncertainty import Uncertainty
    from model.table.build import build_table

    identified = Uncertainty(
        gain=0.015, phase_deg=1.5, thickness=0.002, stiffness=0.01, damping=1.1, fingertip=0.5
    )
    sets = [(k, options.fingers - k) for k in range(1, 5)] if options.fingers else SETS
    figures = "cost [dB]" if options.modulation else "kept    time"
    print(f"{'rig':12} {'uncertainty':11} {'fingers':>7} {'worst finger [dB]':>18} {figures}")
    for name in options.only or PLATES:
        rig = load_rig(EXAMPLES / f"{name}.yaml")
        for label, uncertainty in (("default", rig.uncertainty), ("identified", identified)):
            table = build_table(
                replace(rig, uncertainty=uncertainty),
                drive_mode="phased",
                frequencies=np.arange(40.0, 321.0, 10.0),
            )
            table.prepare(with_ringing=False)
            for contents, quiet in sets:
                apart = (0.08 if name == "table" else 0.05) * (0.6 if options.fingers else 1)
                row = (name, label), table, contents, quiet
                if options.modulation:
                    _print_modulated(*row, options.modulation, options.sets, apart=apart)
                else:
                    _print_row(*row, count=options.sets, apart=apart)


def _print_row(
    names: tuple[str, str],
    table: "LocalizationTable",
    contents: int,
    quiet: int,
    *,
    count: int,
    apart: float,
) -> None:
    import numpy as np

    from model.table.answer import answer
    from model.table.request import Finger, Request

    rng = np.random.default_rng([contents, quiet])
    worst, kept, times = [], [], []
    size = (table.plate.length, table.plate.width)
    for number in range(count):
        drawn = random_contacts(rng, contents + quiet, size, apart=apart)
        places = [(float(x), float(y)) for x, y in drawn]
        requests = [Request(at) for at in places[:contents]]
        fingers = [Finger(at) for at in places[contents:]]
        started = time.process_time()
        found = answer(table, requests, fingers, apart_hz=20, min_contrast_db=-np.inf)
        times.append(1e3 * (time.process_time() - started))
        if found.promised_worst_db is None:
            raise ValueError("a set must have two fingers")
        worst.append(found.promised_worst_db)
        kept.append(_kept(table, found, [each.at for each in fingers], seed=number))
    print(
        f"{names[0]:12} {names[1]:11} {contents:4d}+{quiet:<2d} {np.median(worst):10.1f} "
        f"({np.percentile(worst, 10):.1f}) {100 * np.mean(kept):5.0f} % {np.median(times):6.1f} ms",
        flush=True,
    )


def _print_modulated(
    names: tuple[str, str],
    table: "LocalizationTable",
    contents: int,
    quiet: int,
    modulation: float,
    count: int,
    *,
    apart: float,
) -> None:
    """Print what side bands cost the worst finger."""
    import numpy as np

    from model.table.answer import answer
    from model.table.modulation import with_modulation
    from model.table.request import Finger, Request

    rng = np.random.default_rng([contents, quiet])
    steady, cost = [], []
    size = (table.plate.length, table.plate.width)
    for _ in range(count):
        drawn = random_contacts(rng, contents + quiet, size, apart=apart)
        places = [(float(x), float(y)) for x, y in drawn]
        requests = [Request(at) for at in places[:contents]]
        fingers = [Finger(at) for at in places[contents:]]
        plain = answer(table, requests, fingers)
        found = with_modulation(
            table, requests, fingers, plain, [modulation, *[None] * (contents - 1)]
        )
        before, after = plain.promised_worst_db, found.promised_worst_db
        if found.layers[0].side_bands and before is not None and after is not None:
            steady.append(before)
            cost.append(before - after)
    if cost:
        print(
            f"{names[0]:12} {names[1]:11} {contents:4d}+{quiet:<2d} {np.median(steady):10.1f} "
            f"        {np.median(cost):5.1f} ({np.max(cost):.1f}), {len(cost)} of {count} served",
            flush=True,
        )


def _kept(
    table: "LocalizationTable", found: "Answer", quiet: list[tuple[float, float]], *, seed: int
) -> float:
    """Share of held-out plates on which the worst finger has what is promised."""
    import numpy as np

    from model.table.exact_plates import draw_plates, powers_on
    from model.table.question import Question

    count = len(found.layers) + len(quiet)
    plates = draw_plates(
        np.random.default_rng([9, seed]),
        table.uncertainty,
        count=HELD_OUT,
        era_count=len(table.eras),
        contact_count=count,
    )
    contents = range(len(found.layers))
    question = Question(tuple(each.request.at for each in found.layers), tuple(quiet))
    weights = table.read_fingertips(question.contacts).fine_weights
    powers = []
    for layer in found.layers:
        rows, power = powers_on(table, question, layer.excitation, plates)
        above = power[0] / table.thresholds[rows[0]] ** 2
        powers.append(above.reshape(*weights.shape, -1))
    power = np.array(powers)
    own = [weights[j] @ np.sqrt(power[j, j]) for j in contents]
    ratios: list[FloatArray] = []
    if len(own) > 1:
        ratios += [
            own[j] / np.sqrt(np.delete(power[:, j], j, axis=0).sum(axis=0).max(axis=0))
            for j in contents
        ]
    for finger in range(len(own), count):
        ratios.append(np.min(own, axis=0) / np.sqrt(power[:, finger].sum(axis=0).max(axis=0)))
    least = 20 * np.log10(np.min(ratios, axis=0))
    return float((least >= (found.promised_worst_db or 0.0)).mean())


if __name__ == "__main__":
    main()
