"""How often intervals of 90 % hold the truth, over plates hidden in a process of their own.

Gains and phases: of every ERA at every frequency, by the uncertainty in the calibrated rig; values:
by their standard errors.
"""

import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from benchmarks.calibration.hidden_plates import CHOSEN, FORMS, gain_deviations
from benchmarks.setting import RIG
from model.arrays import FloatArray
from model.calibration.calibrate import calibrate
from model.calibration.responses import Responses, responses_of
from model.calibration.responses_file import read_functions
from model.diagnosis.consistency import check_consistency
from model.errors import InputError
from model.rig.file import load_rig
from model.rig.rig import Rig

_NORMAL = 1.645  # standard errors either side: 90 %


def deviations(
    rig: Rig, responses: Responses, truth: dict[str, list[float]]
) -> dict[str, tuple[FloatArray, float]]:
    """Errors in standard errors by kind of value, and the standard error, relative."""
    check_consistency(rig, responses)
    found = calibrate(rig, responses)
    real, imaginary = np.array(truth["gains"])
    gains, phases = gain_deviations(found.rig, real + 1j * imaginary)
    known = found.rig.uncertainty
    by_kind = {
        "gain": (gains.ravel(), known.gain),
        "phase": (phases.ravel(), float(np.radians(known.phase_deg))),
    }
    values = defaultdict(list)
    for one, true in zip(found.parameters, truth["values"], strict=True):
        if one.standard_error is not None:
            off = abs(one.value - true) / one.standard_error
            values[one.parameter.kind].append((off, one.standard_error / true))
    for kind, rows in values.items():
        off, size = np.array(rows).T
        by_kind[kind] = off, float(np.median(size))
    return by_kind


def show(form: str, count: int) -> None:
    """Print a table of kinds of values by the number of sensors."""
    rig = load_rig(RIG)
    held: dict[tuple[str, int], list[float]] = defaultdict(list)
    sizes: dict[tuple[str, int], list[float]] = defaultdict(list)
    refused = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = [sys.executable, "-m", "benchmarks.calibration.hidden_plates"]
        subprocess.run([*program, name, str(count), form], check=True)
        for seed in range(count):
            truth = json.loads((folder / f"{seed}.json").read_text())
            for sensors in CHOSEN:
                measured = read_functions(folder / f"{seed}-{sensors}.csv")
                try:
                    found = deviations(rig, responses_of(measured, rig), truth)
                except InputError as error:
                    refused += 1
                    print(f"plate {seed}, {sensors} sensors refused: {error}", flush=True)
                    continue
                for kind, (off, size) in found.items():
                    held[kind, sensors] += (off < _NORMAL).tolist()
                    sizes[kind, sensors].append(size)
    print(f"form errors {form}: {count} plates, {refused} calibrations refused")
    print("intervals of 90 % that hold the truth (median standard error), by sensors")
    print(f"{'':>12} " + " ".join(f"{sensors:>16d}" for sensors in CHOSEN))
    for kind in dict.fromkeys(kind for kind, _ in held):
        cells = [
            f"{100 * np.mean(held[kind, n]):5.1f} % ({100 * np.median(sizes[kind, n]):.2f} %)"
            for n in CHOSEN
        ]
        print(f"{kind:>12} " + " ".join(f"{cell:>16}" for cell in cells), flush=True)


def main(count: int) -> None:
    for form in FORMS:
        show(form, count)
