"""Boards whose parts deviate, measured by one moved sensor, calibrated, touched: against the truth.

    python -m benchmarks.weekend.chain [--boards 10] [--touches 20] [--workers 2] [--report]
    python -m benchmarks.weekend.chain --measured examples/weekend/measured.uff

Each is the board of examples/weekend/rig.yaml as it may be built: exciters, drives, board and feet
drawn within the rig's uncertainty, force factors and magnets by 10 %. The sensor of
examples/weekend/places.csv reads its responses there, with noise, put by hand (half a millimetre
off, and reading 1 % more or less at each place); `era calibrate` fits the rig. Of
a table of the rig as bought, of the one fitted, and of the board as it is, exactly known but for
the loads of fingers, the same random touches are answered, and felt on the board in the steady
state: contrast beyond 25 dB counts as 25. In memory,
without a sound card. With --report, the page docs/how-to/a-plate-for-a-weekend.md has the table.
"""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

import era_haptics as era
from benchmarks.calibration.hidden_plates import FORM
from benchmarks.setting import random_contacts, write_parts
from benchmarks.weekend.boards import EDGE, LEVEL_DB_SL, PAGE, ROOT, SEED, sensed
from era_haptics.lab.measuring.sound_card import WiredSensor, read_sensors
from model.answer.answer import Answer
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.estimate.calibrate import calibrate
from model.estimate.measurement import Measurement, write_responses
from model.finger import fingertips_on
from model.reduction.free_plate import FreePlate, solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.structure.attachments import PointLoad, fingertip_loads
from model.structure.exciter import Exciter
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from sim.plant.imperfections import draw_imperfections

FOLDER = ROOT / "examples" / "weekend"
FORCE_FACTOR, MAGNET = 0.1, 0.1
"""Beside the rig's uncertainty, standard deviations of what that does not have, relative."""
NOISE = 2e-3  # of a sensor's root mean square, each part
COUNTED_DB = 25.0
"""Contrast beyond that is not noticed as more."""


@dataclass(frozen=True, eq=False)
class BuiltBoard:
    """A board as it is: its rig with true values, drives among them."""

    rig: Rig
    free: FreePlate

    @classmethod
    def drawn(cls, rig: Rig, seed: int) -> "BuiltBoard":
        """Draw a board within the uncertainty of a rig, and of parts beyond it."""
        rng = np.random.default_rng([SEED, seed])
        drawn = draw_imperfections(rig, seed=seed)
        real = drawn.plate.realised(rig)
        eras = tuple(
            replace(
                each,
                force_factor=each.force_factor * (1 + FORCE_FACTOR * rng.standard_normal()),
                magnet_mass=each.magnet_mass * (1 + MAGNET * rng.standard_normal()),
                gains=((100.0, float(abs(gain)), float(np.angle(gain))),),
            )
            for each, gain in zip(real.eras, drawn.factors(rig), strict=True)
            if isinstance(each, Exciter)
        )
        real = replace(real, eras=eras)
        free = solve_free_plate(real.plate, real.mesh, frequency_max=real.limits.frequency_max)
        return cls(real, free)

    def responses(
        self, points: FloatArray, frequencies: FloatArray, loads: Sequence[Any] = ()
    ) -> ComplexArray:
        """Acceleration [m/s²] of each exciter at full level, (f, e, p)."""
        masses = [*self.rig.masses, *loads]
        return self.free.acceleration(self.rig.eras, frequencies, points, loads=masses)

    def measured(self, frequencies: FloatArray, seed: int) -> Measurement:
        """Responses by one sensor that is moved, with its noise."""
        places = sensor_places(self.rig)
        found = np.concatenate(
            [
                self.responses(
                    np.array([[at.x, at.y]]), frequencies, [PointLoad(at.x, at.y, mass=at.mass)]
                )
                * (at.sensitivity / meant.sensitivity)
                for at, meant in zip(put_by_hand(places, seed), places, strict=True)
            ],
            axis=2,
        )
        found /= np.array([each.full_level for each in self.rig.eras])[:, None]
        rms = np.sqrt((np.abs(found) ** 2).mean(axis=(0, 1)))
        real, imaginary = np.random.default_rng([SEED, seed, 1]).standard_normal((2, *found.shape))
        heard = found + NOISE * rms * (real + 1j * imaginary)
        return Measurement([at.place for at in places], frequencies, heard.swapaxes(1, 2))

    @property
    def exactly_known(self) -> Rig:
        """The rig of one who knows all but the loads of fingers."""
        loads = self.rig.uncertainty.fingertip
        return replace(self.rig, uncertainty=replace(Uncertainty.none(), fingertip=loads))

    def contrast(self, answer: Answer, factors: FloatArray) -> float:
        """Felt contrast [dB] of an answer under fingers whose loads differ by factors."""
        plate, fingers = self.rig.plate, [each.finger.at for each in answer.fingers]
        points, weights = fingertips_on(np.array(fingers), length=plate.length, width=plate.width)
        loads = [
            replace(each, fingertip=each.fingertip.multiplied(float(factor)))
            for each, factor in zip(
                fingertip_loads(self.rig.fingertip, fingers), factors, strict=True
            )
        ]

        def response(frequency: float) -> ComplexArray:
            at = points.reshape(-1, 2)
            return np.asarray(self.responses(at, np.array([frequency]), loads)[0])

        return sensed(answer, self.rig, response, weights)


def sensor_places(rig: Rig) -> Sequence[WiredSensor]:
    """Where the sensor of the example is to be put."""
    return read_sensors(FOLDER / "places.csv", rig.plate, may_move=True)


def put_by_hand(places: Sequence[WiredSensor], seed: int) -> Sequence[WiredSensor]:
    """Where a hand puts the sensor, and what it reads there: with its wax, and not quite upright.

    Off by what hidden plates have their sensors off by.
    """
    off = np.random.default_rng([SEED, seed, 3]).standard_normal((len(places), 3))
    off *= [FORM["sensor_place"], FORM["sensor_place"], FORM["sensor_scale"]]
    return [
        replace(at, x=at.x + x, y=at.y + y, sensitivity=at.sensitivity * (1 + scale))
        for at, (x, y, scale) in zip(places, off.tolist(), strict=True)
    ]


@dataclass(frozen=True)
class Touch:
    """A touch [dB]: promised as bought and calibrated, felt by that, and by exact knowledge."""

    quiet: int
    bought: float
    promised: float
    felt: float
    exact: float


def measured(rig: Rig, seed: int) -> tuple[BuiltBoard, Measurement]:
    """Build a board and measure it."""
    built = BuiltBoard.drawn(rig, seed)
    lines = np.arange(rig.limits.frequency_min + 1, rig.limits.frequency_max, 10.0)
    return built, built.measured(lines, seed)


def touches(rig: Rig, seed: int, count: int) -> Iterator[Touch]:
    """Build, measure, calibrate and touch a board; count: for each number of quiet fingers."""
    built, responses = measured(rig, seed)
    known = calibrate(rig, responses).rig
    tables = [phased_table(each) for each in (rig, known, built.exactly_known)]
    for fingers in random_fingers(rig, seed, count):
        bought, calibrated, exact = (fingers.query(each) for each in tables)
        yield Touch(
            len(fingers.quiet),
            promised_by(bought),
            promised_by(calibrated),
            built.contrast(calibrated, fingers.factors),
            built.contrast(exact, fingers.factors),
        )


@dataclass(frozen=True)
class Fingers:
    """A target and quiet fingers at places [m], and by which factor the load of each is another."""

    target: tuple[float, float]
    quiet: tuple[tuple[float, float], ...]
    factors: FloatArray

    def query(self, table: LocalizationTable) -> Answer:
        """The answer of a table."""
        return era.query(table, self.target, quiet=self.quiet, level_db_sl=LEVEL_DB_SL)


def random_fingers(rig: Rig, seed: int, count: int) -> Iterator[Fingers]:
    """Draw fingers on a board; count: for each number of quiet ones."""
    rng = np.random.default_rng([SEED, seed, 2])
    size = (rig.plate.length, rig.plate.width)
    for number in range(2 * count):
        places = random_contacts(rng, 2 + number % 2, size, margin=EDGE).tolist()
        target, *quiet = ((x, y) for x, y in places)
        factors = np.exp(rig.uncertainty.fingertip * rng.standard_normal(len(places)))
        yield Fingers(target, tuple(quiet), factors)


def frequencies_of(rig: Rig) -> FloatArray:
    """Frequencies of the tables [Hz]."""
    return np.arange(rig.limits.frequency_min, rig.limits.frequency_max + 1, 10.0)


def phased_table(rig: Rig) -> LocalizationTable:
    """The table of a rig."""
    return build_table(rig, frequencies=frequencies_of(rig), drive_mode="phased")


def promised_by(answer: Answer) -> float:
    """Contrast that an answer promises to the target [dB]."""
    promised = answer.fingers[0].promised_contrast_db
    assert promised is not None
    return promised


def rig_as_bought() -> Rig:
    """The rig of the example."""
    return load_rig(FOLDER / "rig.yaml")


def outcome(board: int, touched: int) -> "Outcome":
    """Touches on a board by its number."""
    try:
        return Outcome(board, tuple(touches(rig_as_bought(), board, touched)))
    except InputError as refused:
        return Outcome(board, (), str(refused))


@dataclass(frozen=True)
class Outcome:
    """Touches on a board; or why its calibration was refused."""

    board: int
    touches: tuple[Touch, ...]
    refused: str = ""


def table(found: Sequence[Outcome]) -> str:
    """The figures as Markdown."""
    touches = [each for one in found for each in one.touches]
    rows = [
        "| quiet | touches | promised as bought / dB | promised / dB | felt / dB "
        f"| board exactly known / dB | kept | lost of the first {COUNTED_DB:g} dB, mean |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in ("1", "2", "all"):
        some = [each for each in touches if name in ("all", str(each.quiet))]
        bought, promised, felt, exact = np.transpose(
            [(t.bought, t.promised, t.felt, t.exact) for t in some]
        )
        lost = np.minimum(exact, COUNTED_DB) - np.minimum(felt, COUNTED_DB)
        medians = " | ".join(f"{np.median(each):.1f}" for each in (bought, promised, felt, exact))
        rows.append(
            f"| {name} | {len(some)} | {medians} | {100 * (felt >= promised).mean():.0f} % "
            f"| {lost.mean():.1f} dB |"
        )
    refused = [f"board {each.board}: {each.refused}" for each in found if each.refused]
    text = f"{len(found)} boards, of which `era calibrate` refused {len(refused)}."
    return "\n".join([*rows, "", text, *refused])


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.weekend.chain", description=__doc__)
    parser.add_argument("--boards", type=int, default=10)
    parser.add_argument("--touches", type=int, default=20, help="for each number of quiet fingers")
    parser.add_argument("--first", type=int, default=0, help="number of the first board")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--measured", type=Path, help="only write what the sensor reads of --first")
    options = parser.parse_args()
    if options.measured:
        rig = rig_as_bought()
        write_responses(options.measured, measured(rig, options.first)[1], rig)
        return
    found = []
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn")) as pool:
        numbers = range(options.first, options.first + options.boards)
        for job in [pool.submit(outcome, number, options.touches) for number in numbers]:
            found.append(job.result())
            one = found[-1]
            print(one.refused or table([one]).splitlines()[-3], flush=True)
    text = table(found)
    print(f"\n{text}")
    if options.report:
        counts = f"--boards {options.boards} --touches {options.touches}"
        run = f"Printed by `python -m benchmarks.weekend.chain {counts} --report`."
        write_parts(PAGE, {"chain": f"{run}\n\n{text}"})


if __name__ == "__main__":
    main()
