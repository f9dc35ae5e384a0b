"""Accuracy of calibration by noise and sensors.

The plate of examples/make_measured.py, measured on the simulated bench; errors of the fitted
values, and contrast of the calibrated rig's patterns on the true plate.
"""

import time
from dataclasses import replace

import numpy as np

from benchmarks.setting import RIG, random_contacts
from examples.make_measured import (
    FREQUENCIES,
    SENSOR,
    record_responses,
    scanning_grid,
    true_rig,
)
from model.calibration.calibrate import calibrate
from model.calibration.calibration_result import Calibration
from model.finger.fingertip import fingertip_points, fingertip_weights
from model.finger.perception import contrast_db
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.table.build import build_table
from model.table.question import Question
from model.table.table import LocalizationTable

GRIDS = ((2, 2), (3, 2), (4, 3), (6, 4))
NOISE = (1.0, 10.0, 100.0)  # times that of the example's sensors
CONTACTS = 30


def measure(rig: Rig, truth: Rig, *, grid: tuple[int, int], noise: float) -> Calibration:
    sensor = replace(SENSOR, noise_density=noise * SENSOR.noise_density)
    sensors = scanning_grid(rig.plate, *grid, like=sensor)
    return calibrate(rig, record_responses(truth, sensors, FREQUENCIES, seed=1))


def errors(found: Calibration, truth: Rig) -> dict[str, float]:
    """The largest relative error of each kind of value that was identified."""
    true = {"modulus": truth.plate.material.E, "loss_factor": truth.plate.loss_factor}
    worst: dict[str, float] = {}
    for one in found.parameters:
        kind, era = one.parameter.kind, one.parameter.era
        exact = getattr(truth.era(era), kind) if era else true[kind]
        if one.is_identified:
            worst[kind] = max(worst.get(kind, 0.0), abs(one.value / exact - 1))
    return worst


def reached(
    truth: LocalizationTable, queried: LocalizationTable, places: np.ndarray, *, drive_mode: str
) -> float:
    """Contrast [dB] of the pattern of a table on the true plate."""
    target, *quiet = [(float(x), float(y)) for x, y in places]
    question = Question((target,), tuple(quiet), level_db_sl=12.0, drive_mode=drive_mode)
    excitation = queried.query(question).excitation

    def peak(place: tuple[float, float]) -> np.ndarray:
        points = fingertip_points(*place, truth.plate)
        return np.asarray(truth.amplitudes(excitation, points)[1].sum(axis=0))

    loudest = np.concatenate([peak(place) for place in quiet])
    return float(contrast_db([peak(target)], loudest, [fingertip_weights(*target, truth.plate)]))


def show_contrast(rig: Rig, truth: Rig, found: Calibration) -> None:
    tables = [build_table(each) for each in (truth, found.rig, rig)]
    print(f"contrast on the true plate, dB, median of {CONTACTS} random contact sets")
    print("     mode quiet  true rig  calibrated  before  most lost")
    for drive_mode in ("switched", "phased"):
        for quiet in (1, 2):
            rng = np.random.default_rng(1)
            sets = [
                random_contacts(rng, 1 + quiet, (rig.plate.length, rig.plate.width), margin=0.02)
                for _ in range(CONTACTS)
            ]
            rows = [
                [reached(tables[0], each, s, drive_mode=drive_mode) for each in tables]
                for s in sets
            ]
            best, regained, before = np.array(rows).T
            print(
                f"{drive_mode:>9} {quiet:5d} {np.median(best):9.1f} {np.median(regained):11.1f} "
                f"{np.median(before):7.1f} {(best - regained).max():10.2f}"
            )


def main() -> None:
    rig = load_rig(RIG)
    truth = true_rig(rig)
    print("largest error of the fitted values, %, by sensors and noise; held: not identified")
    kinds = ("modulus", "loss_factor", "stiffness", "damping", "bolt_mass")
    print(f"{'sensors':>8} {'noise':>6} " + " ".join(f"{kind:>12}" for kind in kinds) + "  held  s")
    for grid in GRIDS:
        for noise in NOISE:
            started = time.perf_counter()
            found = measure(rig, truth, grid=grid, noise=noise)
            worst = errors(found, truth)
            held = sum(not one.is_identified for one in found.parameters)
            cells = [f"{100 * worst[kind]:12.2f}" if kind in worst else 12 * " " for kind in kinds]
            elapsed = time.perf_counter() - started
            count = grid[0] * grid[1]
            print(f"{count:8d} {noise:6g} {' '.join(cells)} {held:5d} {elapsed:4.1f}", flush=True)
    print()
    show_contrast(rig, truth, measure(rig, truth, grid=(4, 3), noise=1.0))
