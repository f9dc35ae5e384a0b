"""Contrast and time of answers to several contents, by number of ERAs.

    python -m benchmarks.contents [--only RIG ...] [--sets N] [--fingers K] [--modulation HZ]
                                 [--distortion PERCENT] [--bands] [--sharing]

The examples with four, eight, twelve and sixteen ERAs, 40 to 320 Hz in steps of 10, fingers 5 cm
apart (8 cm on the table) with contents of 20 dB SL, 20 Hz apart; `identified`: with an uncertainty
as after `era rig identify`. For every number of contents and quiet fingers the worst finger that
nine of ten plates promise: median over the sets (and their worst tenth); share of exactly solved
plates that keep the promise (`model.study.verification`); processor time of an answer on one
thread, median. With --fingers so many fingers in all, 3 cm apart, for the times. With --modulation
contents 30 Hz apart, of which the first comes and goes so often: what that costs the worst finger
where it is served, median over the sets (and the most). With --distortion amplifiers whose second
harmonic is so much of full level: contents above all second harmonics, sums and differences up to
500 Hz at their fingers [dB], median (and least), and above those nearer than 30 Hz. With --bands
two and three contents, each in another band of 40 to 110, 140 to 190 and 230 to 320 Hz, whichever
promises most; the time is that of all answers which this takes. With --sharing 2 to 20 fingers of
one content beside 0 to 6 quiet ones in turn, 2.5 cm apart: what a search from every target, of 400
iterations, promises beyond the answer in contrast at the worst finger for 20 dB SL, and in level
where 60 are asked for [dB], median (and worst tenth), both with their time; how many times as long
an answer takes without kernels in C.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from benchmarks.promise.cases import IDENTIFIED
from benchmarks.setting import random_contacts
from model import drive_modes as coherent
from model.answer.answer import APART_HZ, Answer, Contents, Stream
from model.answer.plan import answer, prepare_answers
from model.answer.stimulus import ANY_BAND, Finger, Placement, Stimulus
from model.answer.tone_search import choose_by_numpy, choose_tones
from model.arrays import FloatArray
from model.rig.rig_file import load_rig
from model.study.verification import draw_plates, powers_on
from model.table.table import LocalizationTable, read_fingertips
from model.table.table_file import build_table
from model.vibration import base_amplitudes

EXAMPLES = Path(__file__).parents[1] / "examples"
PLATES = ("paper_plate", "eight_eras", "car_display", "table")
SETS = ((1, 1), (2, 0), (3, 0), (4, 0), (2, 1), (2, 2))
BANDS = ((40.0, 110.0), (140.0, 190.0), (230.0, 320.0))
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
    parser.add_argument("--distortion", type=float, metavar="PERCENT", help="of full level")
    parser.add_argument("--bands", action="store_true", help="a band for each content")
    parser.add_argument("--sharing", action="store_true", help="2 to 20 fingers of one content")
    options = parser.parse_args()

    sets = [(k, options.fingers - k) for k in range(1, 5)] if options.fingers else SETS
    if options.bands:
        sets = [(2, 0), (3, 0)]
    column = "above products" if options.distortion else "worst finger [dB]"
    figures = "" if options.distortion else "cost [dB]" if options.modulation else "kept    time"
    print(f"{'rig':12} {'uncertainty':11} {'fingers':>7} {column:>18} {figures}")
    for name in options.only or PLATES:
        rig = load_rig(EXAMPLES / f"{name}.yaml")
        for label, uncertainty in (("default", rig.uncertainty), ("identified", IDENTIFIED)):
            table = build_table(
                replace(rig, uncertainty=uncertainty),
                drive_mode="phased",
                frequencies=np.arange(40.0, 501.0 if options.distortion else 321.0, 10.0),
            )
            prepare_answers(table)
            if options.sharing:
                _print_sharing((name, label), table, count=options.sets)
                continue
            for contents, quiet in sets:
                apart = (0.08 if name == "table" else 0.05) * (0.6 if options.fingers else 1)
                row = (name, label), table, contents, quiet
                if options.distortion:
                    _print_distorted(*row, options.distortion, options.sets, apart=apart)
                elif options.modulation:
                    _print_modulated(*row, options.modulation, options.sets, apart=apart)
                else:
                    _print_row(*row, options.bands, count=options.sets, apart=apart)


def _sets(
    table: LocalizationTable, contents: int, quiet: int, *, count: int, apart: float
) -> Iterator[list[tuple[float, float]]]:
    """Places [m] of fingers, those with contents first."""
    rng = np.random.default_rng([contents, quiet])
    size = (table.plate.length, table.plate.width)
    for _ in range(count):
        drawn = random_contacts(rng, contents + quiet, size, apart=apart)
        yield [(float(x), float(y)) for x, y in drawn]


def _print_row(
    names: tuple[str, str],
    table: LocalizationTable,
    contents: int,
    quiet: int,
    has_bands: bool,
    *,
    count: int,
    apart: float,
) -> None:

    choices = list(combinations(BANDS, contents)) if has_bands else [(ANY_BAND,) * contents]

    worst, kept, times, asked = [], [], [], []
    for places in _sets(table, contents, quiet, count=count, apart=apart):
        started = time.process_time()
        tried = [
            answer(
                table,
                [
                    Finger(at, Stimulus(band_hz=band))
                    for at, band in zip(places, bands, strict=False)
                ],
                quiet=places[contents:],
                apart_hz=20,
                bands_may_swap=has_bands,
                drive_mode="phased",
                min_contrast_db=-np.inf,
            )
            for bands in choices
        ]
        times.append(1e3 * (time.process_time() - started))
        asked.append((max(tried, key=promised_worst), places[contents:]))
    for number, (found, left) in enumerate(asked):  # afterwards: a live answer follows another
        worst.append(promised_worst(found))
        kept.append(share_kept(table, found, left, seed=number))
    print(
        f"{names[0]:12} {names[1]:11} {contents:4d}+{quiet:<2d} {np.median(worst):10.1f} "
        f"({np.percentile(worst, 10):.1f}) {100 * np.mean(kept):5.0f} % {np.median(times):6.1f} ms",
        flush=True,
    )


def promised_worst(found: Answer) -> float:
    if found.promised_worst_db is None:
        raise ValueError("a set must have two fingers")
    return found.promised_worst_db


def _print_sharing(names: tuple[str, str], table: LocalizationTable, *, count: int) -> None:
    """Print what a search that takes its time finds beyond the answers."""
    chosen = coherent.TARGET_STARTS, coherent.ALIGNMENTS, coherent.REALIGNMENTS
    coherent.TARGET_STARTS, coherent.ALIGNMENTS, coherent.REALIGNMENTS = 20, 400, 100
    patient = replace(table)
    prepare_answers(patient)  # kernels read the numbers once for a table
    coherent.TARGET_STARTS, coherent.ALIGNMENTS, coherent.REALIGNMENTS = chosen
    for targets in (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20):
        lost: dict[float, list[float]] = {20.0: [], 60.0: []}
        spent = defaultdict[tuple[bool, float], list[float]](list)
        for quiet in range(min(7, 21 - targets)):
            for places in _sets(table, targets, quiet, count=count // 7 + 1, apart=0.025):
                shared, others = range(targets), range(targets, targets + quiet)
                background = None if quiet else table.background(places[:targets])
                for level in lost:
                    stream = Stream(tuple(shared), level, ((0, len(table.frequencies)),))
                    asked = tuple(places), (), (stream,), tuple(others)
                    contents = Contents(*asked, background=background)
                    best = choose_tones(patient, contents)
                    for choose in (choose_tones, choose_by_numpy):
                        found = choose(table, contents)  # once for what so many fingers need
                        started = time.process_time()
                        found = choose(table, contents)
                        spent[choose is choose_tones, level].append(time.process_time() - started)
                    if level > 20:
                        most, least = (
                            min(each.level_db_sl[finger][1] for finger in shared)
                            for each in (best, found)
                        )
                        lost[level].append(most - least)
                    elif quiet:
                        lost[level].append(best.worst_db - found.worst_db)
        times = {each: 1e3 * np.median(some) for each, some in spent.items()}
        figures = "   ".join(
            f"{np.median(some):5.2f} ({np.percentile(some, 90):.2f}) {times[True, level]:6.1f} ms"
            for level, some in lost.items()
            if some
        )
        slower = times[False, 20.0] / times[True, 20.0]
        row = (
            f"{names[0]:12} {names[1]:11} {targets:4d} share   {figures}   numpy {slower:.1f} times"
        )
        print(row, flush=True)


def _print_modulated(
    names: tuple[str, str],
    table: LocalizationTable,
    contents: int,
    quiet: int,
    modulation: float,
    count: int,
    *,
    apart: float,
) -> None:
    """Print what side bands cost the worst finger."""
    steady, cost = [], []
    for places in _sets(table, contents, quiet, count=count, apart=apart):
        fingers, others = [Finger(at, Stimulus()) for at in places[:contents]], places[contents:]
        plain = answer(table, fingers, quiet=others, drive_mode="phased")
        fingers[0] = replace(fingers[0], stimulus=Stimulus(modulation_hz=modulation))
        found = answer(table, fingers, quiet=others, drive_mode="phased")
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


def _print_distorted(
    names: tuple[str, str],
    table: LocalizationTable,
    contents: int,
    quiet: int,
    percent: float,
    count: int,
    *,
    apart: float,
) -> None:
    """Print how far each content is above the second harmonics, sums and differences there."""
    above, near = [], []
    strokes = np.array([era.full_level for era in table.eras])
    for places in _sets(table, contents, quiet, count=count, apart=apart):
        stimulus = Stimulus(band_hz=(40.0, 320.0))
        found = answer(
            table,
            [Finger(at, stimulus) for at in places[:contents]],
            quiet=places[contents:],
            drive_mode="phased",
            min_contrast_db=-np.inf,
        )
        tones = []
        for layer in found.layers:
            frequencies, bases = base_amplitudes(layer.excitation, table.eras)
            tones.append((float(frequencies[0]), bases[0] / strokes))
        products = []
        for number, (f, weights) in enumerate(tones):
            products.append((2 * f, weights**2))
            for low, other in tones[:number]:
                difference = weights * other.conj() if f >= low else other * weights.conj()
                products += [(f + low, 2 * weights * other), (abs(f - low), 2 * difference)]
        fields = table.unit_fields(np.array(places), contacts=places)
        for finger, felt in enumerate(found.fingers[:contents]):
            own, total = 10 ** (felt.promised_level_db_sl / 20), 1e-20
            for f, weights in products:
                (rows,) = np.nonzero(np.isclose(table.frequencies, f))
                for row in rows:
                    made = abs((percent / 100 * weights * fields[row, :, finger]).sum())
                    sensed = float(made / table.thresholds[row])
                    total += sensed**2
                    if abs(f - tones[finger][0]) < APART_HZ:
                        near.append(20 * np.log10(own / sensed))
            above.append(20 * np.log10(own / np.sqrt(total)))
    print(
        f"{names[0]:12} {names[1]:11} {contents:4d}+{quiet:<2d} {np.median(above):10.1f} "
        f"({np.min(above):.1f})"
        + (f", near a content {np.median(near):.1f} ({np.min(near):.1f})" if near else ""),
        flush=True,
    )


def share_kept(
    table: LocalizationTable, found: Answer, quiet: list[tuple[float, float]], *, seed: int
) -> float:
    """Share of held-out plates on which the worst finger has what is promised."""
    count = len(found.layers) + len(quiet)
    plates = draw_plates(
        np.random.default_rng([9, seed]),
        table.uncertainty,
        count=HELD_OUT,
        of=table,
        contact_count=count,
    )
    contents = range(len(found.layers))
    targets = tuple(each.at for each in found.asked if each.stimulus)
    placed = Placement(targets, tuple(quiet))
    weights = read_fingertips(table, placed.contacts).fine_weights
    powers = []
    for layer in found.layers:
        rows, power = powers_on(table, placed, layer.excitation, plates)
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
