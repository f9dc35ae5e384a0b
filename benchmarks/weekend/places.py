"""How well a board of a weekend is known by few places of its sensor.

    python -m benchmarks.weekend.places [--boards 4] [--places 4,5,6,8,12] [--report]

Boards are those of `benchmarks.weekend.chain`, of whose twelve places some are kept, drawn by the
board's number: of fewer places are some of those of more. `era calibrate` fits the rig, and what it
predicts at other points and between the tones is compared with the board. With --report, the page
docs/how-to/calibration.md has the table.
"""

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np

from benchmarks.setting import write_parts
from benchmarks.weekend.boards import ROOT
from benchmarks.weekend.chain import FOLDER, measured
from model.errors import InputError
from model.estimate.calibrate import calibrate
from model.reduction.free_plate import solve_free_plate
from model.rig.rig_file import load_rig

PAGE = ROOT / "docs" / "how-to" / "calibration.md"
FREQUENCIES = np.arange(95.0, 296.0, 10.0)
_POINTS = 60
_KEPT_OFF = 0.05  # of a side, at its edges


@dataclass(frozen=True)
class Known:
    """What is known of a board: errors relative to the rms of a response over the board.

    error: rms over points, frequencies and exciters; stated: of gains, in the rig; refused: why
    there is no rig.
    """

    error: float = np.nan
    stated: float = np.nan
    refused: str = ""


def known_by(board: int, count: int) -> Known:
    """How well a board is known by a number of places."""
    rig = load_rig(FOLDER / "rig.yaml")
    built, responses = measured(rig, board)
    order = np.random.default_rng([7, board]).permutation(len(responses.sensors))
    some = responses.without(~np.isin(np.arange(len(order)), order[:count]))
    try:
        found = calibrate(rig, some)
    except InputError as refused:
        return Known(refused=str(refused))
    if not found.is_good:
        return Known(refused="predicts no place that it was not shown")
    known = found.rig
    sides = [rig.plate.length, rig.plate.width]
    points = np.random.default_rng(5).uniform(_KEPT_OFF, 1 - _KEPT_OFF, (_POINTS, 2)) * sides
    free = solve_free_plate(known.plate, known.mesh, frequency_max=rig.limits.frequency_max)
    predicted = free.acceleration(known.eras, FREQUENCIES, points, loads=known.masses)
    true = built.responses(points, FREQUENCIES)
    size = np.sqrt((np.abs(true) ** 2).mean(axis=2, keepdims=True))
    error = float(np.sqrt((np.abs((predicted - true) / size) ** 2).mean()))
    return Known(error, known.uncertainty.gain)


def row(count: int, found: Sequence[Known]) -> str:
    """A line of the table."""
    good = [each for each in found if not each.refused]
    shown = "– | – | –"
    if good:
        errors, stated = np.transpose([(each.error, each.stated) for each in good])
        values = (np.median(errors), errors.max(), np.median(stated))
        shown = " | ".join(f"{100 * value:.1f} %" for value in values)
    return f"| {count} | {len(found)}, {len(found) - len(good)} | {shown} |"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.weekend.places")
    parser.add_argument("--boards", type=int, default=4)
    parser.add_argument("--places", default="4,5,6,8,12")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    lines = [
        "| places | boards, refused | error of the field, median | largest | gain as stated |",
        "|---|---|---|---|---|",
    ]
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        for count in map(int, options.places.split(",")):
            jobs = [pool.submit(known_by, board, count) for board in range(options.boards)]
            lines.append(row(count, [each.result() for each in jobs]))
            print(lines[-1], flush=True)
    if options.report:
        run = f"python -m benchmarks.weekend.places --boards {options.boards} "
        run += f"--places {options.places} --report"
        write_parts(PAGE, {"places": "\n".join([f"Printed by `{run}`.", "", *lines])})


if __name__ == "__main__":
    main()
