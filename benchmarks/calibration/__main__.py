"""Coverage of a calibration's intervals: `python -m benchmarks.calibration [PLATES] [SHARE]`.

Prints the table in the section Calibration of docs/measured/figures.md, by the number of sensors:
how often 90 % intervals contain the true value on plates that another process hides. SHARE is the
size of form errors relative to the errors that a fit allows for.

Gain, phase: effect of every ERA at every frequency, compared with the uncertainty in the calibrated
rig. Field: the error of the field with the best gains, root mean square over the plate. Other
values are compared with their standard errors.
"""

import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

from benchmarks.calibration.hidden_plates import CHOSEN, field_deviations, sensors_of
from benchmarks.setting import RIG
from model.arrays import FloatArray
from model.errors import InputError
from model.estimate.calibrate import calibrate
from model.estimate.measurement import Measurement
from model.response_files import measurement_of, read_measured
from model.rig.rig import Rig
from model.rig.rig_file import load_rig

_CHUNK = 20  # plates
_NORMAL = 1.645  # standard errors either side: 90 %


def deviations(
    rig: Rig, responses: Measurement, truth: dict[str, list[float]]
) -> dict[str, tuple[FloatArray, float]]:
    """Return errors in standard errors, and relative standard errors, by kind of value."""
    found = calibrate(rig, responses)
    real, imaginary = np.array(truth["fields"])
    gains, phases, fields = field_deviations(found.rig, real + 1j * imaginary)
    known = found.rig.uncertainty
    by_kind = {
        "gain": (gains.ravel(), known.gain),
        "field": (fields.ravel(), known.field),
        "phase": (phases.ravel(), float(np.radians(known.phase_deg))),
    }
    values = defaultdict(list)
    for one, true in zip(found.parameters, truth["values"], strict=True):
        if one.standard_error is not None:
            off = abs(one.value - true) / one.standard_error
            values[one.kind].append((off, one.standard_error / true))
    for kind, rows in values.items():
        off, size = np.array(rows).T
        by_kind[kind] = off, float(np.median(size))
    return by_kind


def main(count: int, share: float) -> None:
    """Print tables of kinds of values over numbers of sensors, for a growing number of plates."""
    rig = load_rig(RIG)
    held: dict[tuple[str, int], list[float]] = defaultdict(list)
    sizes: dict[tuple[str, int], list[float]] = defaultdict(list)
    refused = 0
    for first in range(0, count, _CHUNK):
        some = min(_CHUNK, count - first)
        with tempfile.TemporaryDirectory() as name:
            program = [sys.executable, "-m", "benchmarks.calibration.hidden_plates"]
            subprocess.run([*program, name, str(first), str(some), str(share)], check=True)
            for seed in range(first, first + some):
                measured = read_measured(Path(name) / f"{seed}.csv")
                truth = json.loads((Path(name) / f"{seed}.json").read_text())
                try:
                    found = deviations(rig, measurement_of(measured, rig), truth)
                except InputError as error:
                    refused += 1
                    print(f"plate {seed} refused: {error}", flush=True)
                    continue
                for kind, (off, size) in found.items():
                    held[kind, sensors_of(seed)] += (off < _NORMAL).tolist()
                    sizes[kind, sensors_of(seed)].append(size)
        print(f"form errors {share:g} of those assumed: {first + some} plates, {refused} refused")
        show(held, sizes)


def show(
    held: dict[tuple[str, int], list[float]], sizes: dict[tuple[str, int], list[float]]
) -> None:
    """Print the coverage of intervals, and median standard errors."""
    print("intervals of 90 % that hold the truth (median standard error), by sensors")
    print(f"{'':>12} " + " ".join(f"{column!s:>16}" for column in (*CHOSEN, "all")))
    for kind in dict.fromkeys(kind for kind, _ in held):
        cells = []
        for columns in (*([n] for n in CHOSEN), list(CHOSEN)):
            shares, errors = (
                np.concatenate([each[kind, n] for n in columns if each[kind, n]] or [[np.nan]])
                for each in (held, sizes)
            )
            cells.append(f"{100 * np.mean(shares):5.1f} % ({100 * np.median(errors):.2f} %)")
        print(f"{kind:>12} " + " ".join(f"{cell:>16}" for cell in cells), flush=True)


PLATES, SHARE = "200", "1"

if __name__ == "__main__":
    plates, share = [*sys.argv[1:], *(PLATES, SHARE)[len(sys.argv) - 1 :]]
    main(int(plates), float(share))
