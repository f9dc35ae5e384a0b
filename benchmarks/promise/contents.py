"""Promises to several contents by number of ERAs: `python -m benchmarks.promise contents`.

The examples with four, eight, twelve and sixteen ERAs, from 40 to 320 Hz in steps of 10; contents
of 20 dB SL at least 20 Hz apart; fingers 5 cm apart, 8 cm on the table. For every number of
contents and quiet fingers: promise to the worst finger, median (worst 10 %); share of plates, drawn
within the uncertainty and solved exactly, that keep it; processor time of an answer on one thread.
"""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from benchmarks.promise.cases import EXAMPLES, IDENTIFIED
from benchmarks.setting import random_contacts
from model.answer.answer import Answer
from model.answer.plan import answer, prepare_answers
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import FloatArray
from model.rig.rig_file import load_rig
from model.study.exact_plates import draw_plates, powers_on
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.table.table_file import build_table

RIGS = ("paper_plate", "eight_eras", "car_display", "table")
SETS = ((1, 1), (2, 0), (3, 0), (4, 0), (2, 1))
"""Numbers of contents and of quiet fingers."""
HELD_OUT = 100  # plates for each set

Position = tuple[float, float]


def run(sets: int) -> None:
    """Print a row for each rig, uncertainty, and number of contents and quiet fingers."""
    print("| rig | uncertainty | contents + quiet | promised [dB] | kept | time [ms] |")
    print("|---|---|---|---|---|---|")
    for name in RIGS:
        rig = load_rig(EXAMPLES / f"{name}.yaml")
        for label, uncertainty in (("default", rig.uncertainty), ("identified", IDENTIFIED)):
            table = build_table(
                replace(rig, uncertainty=uncertainty),
                drive_mode="phased",
                frequencies=np.arange(40.0, 321.0, 10.0),
            )
            prepare_answers(table)
            for contents, quiet in SETS:
                row = _row(table, contents, quiet, sets, apart=0.08 if name == "table" else 0.05)
                print(f"| {name} | {label} | {contents}+{quiet} | {row} |", flush=True)


def _row(table: LocalizationTable, contents: int, quiet: int, sets: int, *, apart: float) -> str:
    rng = np.random.default_rng([contents, quiet])
    size = (table.plate.length, table.plate.width)
    asked: list[tuple[Answer, list[Position]]] = []
    times = []
    for _ in range(sets):
        drawn = random_contacts(rng, contents + quiet, size, apart=apart)
        positions = [(float(x), float(y)) for x, y in drawn]
        fingers = [Finger(at, Stimulus()) for at in positions[:contents]]
        begin = time.process_time()
        best = answer(
            table,
            fingers,
            quiet=positions[contents:],
            apart_hz=20,
            drive_mode="phased",
            min_contrast_db=-np.inf,
        )
        times.append(1e3 * (time.process_time() - begin))
        asked.append((best, positions[contents:]))
    # Evaluated afterwards, because live answers follow each other.
    promises = [promised_worst(best) for best, _ in asked]
    kept = [share_kept(table, *each, seed=number) for number, each in enumerate(asked)]
    promised = f"{np.median(promises):.1f} ({np.percentile(promises, 10):.1f})"
    return f"{promised} | {100 * np.mean(kept):.0f} % | {np.median(times):.1f}"


def promised_worst(best: Answer) -> float:
    """Return the promise [dB] to the worst of at least two fingers."""
    assert best.promised_worst_db is not None
    return best.promised_worst_db


def share_kept(
    table: LocalizationTable, best: Answer, quiet: Sequence[Position], *, seed: int
) -> float:
    """Return the share of held-out plates on which the worst finger has the promised contrast."""
    targets = tuple(finger.at for finger in best.asked if finger.stimulus)
    placed = Placement(targets, tuple(quiet))
    plates = draw_plates(
        np.random.default_rng([9, seed]),
        table.uncertainty,
        count=HELD_OUT,
        of=table,
        contact_count=len(placed.contacts),
    )
    weights = read_fingertips(table, placed.contacts).fine_weights.astype(float)
    powers = []  # of each layer (fingers, points, plates), relative to the threshold
    for layer in best.layers:
        rows, power = powers_on(table, placed, layer.excitation, plates)
        relative = power[0] / table.thresholds[rows[0]] ** 2
        powers.append(relative.reshape(*weights.shape, -1))
    contrasts = _contrasts(np.array(powers), weights, len(targets))
    return float((contrasts.min(axis=0) >= promised_worst(best)).mean())


def _contrasts(powers: FloatArray, weights: FloatArray, targets: int) -> FloatArray:
    """Contrasts [dB] of targets to all other contents, and of the weakest to quiet fingers."""
    own = np.array([weights[j] @ np.sqrt(powers[j, j]) for j in range(targets)])
    ratios = []
    for finger in range(len(weights)):
        foreign = powers[:, finger]
        if finger < targets:
            foreign = np.delete(foreign, finger, axis=0)
        if len(foreign):
            loudest = np.sqrt(foreign.sum(axis=0).max(axis=0))
            felt = own[finger] if finger < targets else own.min(axis=0)
            ratios.append(20 * np.log10(felt / loudest))
    return np.array(ratios)
