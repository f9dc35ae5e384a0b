"""How often intervals of 95 % hold the truth, over plates hidden in a process of their own."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.calibration.hidden_plates import FORMS
from benchmarks.setting import RIG
from model.calibration.calibrate import calibrate
from model.calibration.calibration_result import Calibration
from model.calibration.responses import responses_of
from model.calibration.responses_file import read_functions
from model.diagnosis.consistency import check_consistency
from model.errors import InputError
from model.rig.file import load_rig

_NORMAL = 1.96  # standard errors either side: 95 %


def hidden(form: str, count: int) -> Iterator[tuple[Calibration | str, list[float]]]:
    """Calibrations of hidden plates, or why one was refused, each with the true values."""
    rig = load_rig(RIG)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = [sys.executable, "-m", "benchmarks.calibration.hidden_plates"]
        subprocess.run([*program, name, str(count), form], check=True)
        for seed in range(count):
            responses = responses_of(read_functions(folder / f"{seed}.csv"), rig)
            try:
                check_consistency(rig, responses)
                found: Calibration | str = calibrate(rig, responses)
            except InputError as error:
                found = str(error)
            yield found, json.loads((folder / f"{seed}.json").read_text())


def show(form: str, count: int) -> None:
    deviations, sizes, kinds = [], [], []
    refused = 0
    for found, truth in hidden(form, count):
        if isinstance(found, str):
            refused += 1
            print(f"refused: {found}", flush=True)
            continue
        for one, true in zip(found.parameters, truth, strict=True):
            if one.standard_error is not None:
                deviations.append((one.value - true) / one.standard_error)
                sizes.append(one.standard_error / true)
                kinds.append(one.parameter.kind)
    held, kind_of = np.abs(deviations) < _NORMAL, np.array(kinds)
    print(f"form errors {form}: {count} plates, {refused} refused")
    print(f"{'value':>12} {'held by 95 %':>13} {'standard error':>15}")
    for kind in dict.fromkeys(kinds):
        share = 100 * held[kind_of == kind].mean()
        size = 100 * np.median(np.array(sizes)[kind_of == kind])
        print(f"{kind:>12} {share:11.1f} % {size:13.2f} %")
    print(f"{'all':>12} {100 * held.mean():11.1f} %", flush=True)


def main(count: int) -> None:
    for form in FORMS:
        show(form, count)
