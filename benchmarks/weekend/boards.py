"""Contrast and level to expect of boards on foam or rubber with four exciters, by kind of board.

    python -m benchmarks.weekend.boards [--touches 40] [--plates 10] [--cases 0,2] [--report]

Each board is that of examples/weekend/rig.yaml with another size, material, feet and exciters, at
the same shares of its sides. Fingers at random, 2 cm from the edge and 5 cm apart, one or two of
them quiet, at 20 dB SL or more, of frequencies 10 Hz apart up to 300 Hz, from where magnets stay
within their excursion in onsets of all at full level. Promised: what nine of ten boards give, as
the table answers. Kept: on boards drawn within the same uncertainty (`SolvedPlate`), in the steady
state, over the whole fingertip of the target and at the loudest point under each quiet one. Level:
of four exciters in phase under a finger, the least over the board but 2 cm at its edge.
With --report, the page docs/how-to/a-plate-for-a-weekend.md has the table.
"""

import argparse
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import era_haptics as era
from benchmarks.setting import random_contacts, write_parts
from era_haptics import SolvedPlate
from model.arrays import ComplexArray, FloatArray
from model.finger import decibels, detection_threshold, fingertips_on
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.rig.rig_writing import change_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.transients.excursions import excursions_of

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "how-to" / "a-plate-for-a-weekend.md"
EDGE, SEED = 0.02, 62  # m
LEVEL_DB_SL = 20.0

ACRYLIC = {"length": 0.3, "width": 0.23, "thickness": 5e-3, "material": "acrylic", "grain": None}
BIRCH: dict[str, Any] = {}  # as in the file
MDF = {"thickness": 6e-3, "material": "mdf", "grain": None, "loss_factor": 0.02}
LOWEST, STEP = 60, 10  # Hz
KNOWN: Mapping[str, Mapping[str, float]] = {
    "as bought": {},
    "measured": {
        "gain": 0.01, "phase_deg": 0.6, "thickness": 0.002, "modulus": 0.004, "stiffness": 0.02,
        "damping": 1.1, "place": 0.0, "harmonic": 0.0, "supports": 0.05,
    },
    "exact": {
        "gain": 0.0, "phase_deg": 0.0, "thickness": 0.0, "modulus": 0.0, "stiffness": 0.0,
        "damping": 1.0, "place": 0.0, "harmonic": 0.0, "supports": 0.0,
    },
}  # fmt: skip
"""What of the rig's uncertainty is replaced; fingers are as unknown in all of them."""


@dataclass(frozen=True)
class Board:
    """A board on feet with exciters of a type."""

    name: str
    plate: Mapping[str, Any]
    feet: str
    exciter: str

    @property
    def rig(self) -> Rig:
        """Its rig, from where magnets stay within their excursion; raises ConfigError."""
        rig = load_rig(ROOT / "examples" / "weekend" / "rig.yaml")
        data: Any = rig.document.data if rig.document else {}
        made = change_rig(
            rig,
            plate=self.plate,
            eras={name: {"type": self.exciter} for name in data["eras"]},
            limits={"frequency": [LOWEST, 300]},
        )
        data = made.document.data if made.document else {}
        feet = {name: {**keys, "kind": self.feet} for name, keys in data["supports"].items()}
        made = change_rig(made, supports=feet)
        lowest = STEP * math.ceil(excursions_of(made).allowed / STEP)
        return change_rig(made, limits={"frequency": [lowest, 300]})


BOARDS = tuple(
    Board(name, plate, feet, exciter)
    for name, plate in (
        ("acrylic 300 x 230 x 5 mm", ACRYLIC),
        ("birch 400 x 300 x 6.4 mm", BIRCH),
        ("MDF 400 x 300 x 6 mm", MDF),
    )
    for feet, exciter in (
        ("foam", "DAEX25FHE-4"),
        ("foam", "DAEX25CT-4"),
        ("foam", "DAEX13-4SM"),
        ("rubber", "DAEX25CT-4"),
    )
)


@dataclass(frozen=True)
class Expected:
    """Of a board: promised contrast [dB] of touches, and whether it was kept, by what is known.

    touches: (known, quiet) -> (n, 2); levels: least level [dB SL] by frequency.
    """

    touches: Mapping[tuple[str, int], Sequence[tuple[float, bool]]]
    levels: Mapping[float, float]


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.weekend.boards", description=__doc__
    )
    parser.add_argument("--touches", type=int, default=40, help="for each number of quiet fingers")
    parser.add_argument("--plates", type=int, default=10, help="drawn, of each board")
    parser.add_argument("--cases", help="numbers of boards, from 0; default: all")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    numbers = [int(n) for n in options.cases.split(",")] if options.cases else range(len(BOARDS))
    chosen = [BOARDS[number] for number in numbers]
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(expected, one, options.touches, options.plates) for one in chosen]
        lines = [*_HEAD]
        for board, job in zip(chosen, jobs, strict=True):
            lines.append(_line(board, job.result()))
            print(lines[-1], flush=True)
    if options.report:
        counts = f"--touches {options.touches} --plates {options.plates}"
        run = f"Printed by `python -m benchmarks.weekend.boards {counts} --report`."
        write_parts(PAGE, {"boards": "\n".join([run, "", *lines])})


_HEAD = (
    "| board | feet | exciters | as bought | measured | exact | kept | from | level there / 200 "
    "/ 300 Hz | 20 dB SL |",
    "|---|---|---|---|---|---|---|---|---|---|",
)


def _line(board: Board, found: Expected) -> str:

    def medians(known: str) -> str:
        return " / ".join(
            f"{np.median([promised for promised, _ in found.touches[known, quiet]]):.0f}"
            for quiet in (1, 2)
        )

    kept = np.mean([is_kept for each in found.touches.values() for _, is_kept in each])
    frequencies = [*found.levels]
    levels = " / ".join(f"{found.levels[f]:.0f}" for f in (frequencies[0], 200.0, 300.0))
    missing = [f"{f:g}" for f in frequencies if found.levels[f] < LEVEL_DB_SL]
    reached = f"but {', '.join(missing)} Hz" if missing else "all"
    columns = " | ".join(f"{medians(known)} dB" for known in KNOWN)
    return (
        f"| {board.name} | {board.feet} | {board.exciter} | {columns} | {100 * kept:.0f} % "
        f"| {frequencies[0]:g} Hz | {levels} | {reached} |"
    )


def expected(board: Board, touches: int, plates: int) -> Expected:
    """Answers and levels of a board."""
    rig = board.rig
    frequencies = np.arange(rig.limits.frequency_min, rig.limits.frequency_max + 1, STEP)
    table = build_table(rig, frequencies=frequencies, drive_mode="phased")
    found = {}
    for known, std in KNOWN.items():
        uncertainty = replace(rig.uncertainty, **std)
        own = replace(table, uncertainty=uncertainty)
        drawn = [
            era.SolvedPlate(replace(rig, uncertainty=uncertainty), seed=n) for n in range(plates)
        ]
        for quiet in (1, 2):
            found[known, quiet] = [*_touches(own, drawn, quiet, touches)]
    return Expected(found, levels(era.SolvedPlate(rig), frequencies.tolist()))


def _touches(
    table: LocalizationTable, drawn: Sequence[SolvedPlate], quiet: int, count: int
) -> Iterator[tuple[float, bool]]:
    """Yield what is promised to random touches, and whether a drawn board keeps it."""
    plate = table.plate
    rng = np.random.default_rng([SEED, quiet])
    for number in range(count):
        size = (plate.length, plate.width)
        target, *others = random_contacts(rng, 1 + quiet, size, margin=EDGE).tolist()
        answer = era.query(table, target, quiet=others, level_db_sl=LEVEL_DB_SL)
        promised = answer.fingers[0].promised_contrast_db
        assert promised is not None
        yield promised, contrast(drawn[number % len(drawn)], answer) >= promised


def contrast(plate: SolvedPlate, answer: Any) -> float:
    """Felt contrast [dB] of an answer in the steady state of a plate under its fingers."""
    fingers, size = [each.finger.at for each in answer.fingers], plate.rig.plate
    points, weights = fingertips_on(np.array(fingers), length=size.length, width=size.width)

    def response(frequency: float) -> ComplexArray:
        places = points.reshape(-1, 2).tolist()
        return np.asarray(plate.responses(places, [frequency], fingers=fingers)[0])

    return sensed(answer, plate.rig, response, weights)


def sensed(
    answer: Any, rig: Rig, response: Callable[[float], ComplexArray], weights: FloatArray
) -> float:
    """Felt contrast [dB]; response: of a frequency, (e, k p) [m/s²] under k fingertips."""
    names = [each.name for each in rig.eras]
    squares: FloatArray = np.zeros(weights.size)
    for layer in answer.layers:
        shares = np.zeros(len(names), dtype=complex)
        for name, tone in layer.excitation.items():
            shares[names.index(name)] = tone.phasor / rig.full_levels[name]
        field = np.abs(shares @ response(layer.frequency))
        squares += (field / detection_threshold(layer.frequency, rig.threshold)) ** 2
    return felt_contrast(np.sqrt(squares).reshape(len(answer.fingers), -1), weights)


def felt_contrast(felt: FloatArray, weights: FloatArray) -> float:
    """Contrast [dB] of what is felt (k, p), relative to the threshold, the target first."""
    return float(decibels(felt[0] @ np.reshape(weights, felt.shape)[0] / felt[1:].max()))


def levels(plate: SolvedPlate, frequencies: Sequence[float]) -> dict[float, float]:
    """Least level [dB SL] over the board but its edges, under a finger, all exciters in phase."""
    rig = plate.rig
    x, y = (
        np.linspace(EDGE, side - EDGE, count)
        for side, count in ((rig.plate.length, 13), (rig.plate.width, 10))
    )
    least = np.full(len(frequencies), np.inf)
    threshold = detection_threshold(np.array(frequencies), rig.threshold)
    for point in np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).tolist():
        found = np.abs(plate.responses([point], frequencies, fingers=[point])).sum(axis=1)[:, 0]
        least = np.minimum(least, decibels(found / threshold))
    return dict(zip(frequencies, least.tolist(), strict=True))


if __name__ == "__main__":
    main()
