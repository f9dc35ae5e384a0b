"""Boards whose parts deviate, measured, calibrated and touched by real processes through JACK.

    python -m benchmarks.weekend.through_jack [--boards 10] [--touches 20] [--report]

The boards and touches of `python -m benchmarks.weekend.chain`. Each board is a process that moves
in time, with viscous losses and amplifiers that lag, on a JACK server of the dummy driver: `era
measure` with one sensor that is moved, `era calibrate`, `era table build`, then `era soft-amp` and
`era daemon`, which gets the fingers that are put on the board. The sensor is put beside its
places, and reads the same at all of them. What fingers feel is kept by the board, half a second
after it begins. As bought and exactly known is answered in memory, and felt in
the steady state. Five minutes a board.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.desk.session import REPEAT, Desk, desk, hold, playing, sizes, until_ready
from benchmarks.desk_plate.desk_plate import SAMPLES, as_built
from benchmarks.setting import write_parts
from benchmarks.weekend.boards import LEVEL_DB_SL, PAGE, ROOT, felt_contrast
from benchmarks.weekend.chain import (
    FOLDER,
    BuiltBoard,
    Fingers,
    Outcome,
    Touch,
    frequencies_of,
    phased_table,
    promised_by,
    put_by_hand,
    random_fingers,
    rig_as_bought,
    sensor_places,
    table,
)
from controller.api.client import Client
from controller.api.link import LeaseLost
from controller.api.methods import StatusResult
from era_haptics.lab.measuring.sound_card import WiredSensor
from model.arrays import FloatArray
from model.finger import fingertips_on
from model.rig.rig import Rig
from model.rig.rig_writing import save_rig

RESULTS = ROOT / "out" / "weekend_through_jack.json"
MESH = "13x11 Legendre"
"""Of the board in time: not that of the rig."""
_LEVEL = 0.2  # of a measurement: more clips the sensor
_SETTLING, _WINDOW = 0.5, 0.4  # s


@dataclass(frozen=True)
class Played:
    """A board through JACK: what came of it, seconds of its measurement, places it did not keep.

    lost: touches that the daemon broke off, and which were repeated; xruns: of the server.
    """

    outcome: Outcome
    measure_s: float
    repeated: int
    lost: int
    xruns: int


def played(number: int, count: int) -> Played:
    """Measure, calibrate and touch a board; count: touches for each number of quiet fingers."""
    rig = rig_as_bought()
    built = BuiltBoard.drawn(rig, number)
    exact = phased_table(_with_lags(built).exactly_known)
    bought = phased_table(rig)
    with tempfile.TemporaryDirectory(prefix="weekend") as name:
        folder = Path(name)
        save_rig(built.exactly_known, folder / "built.yaml")
        (folder / "put.csv").write_text(_as_csv(put_by_hand(sensor_places(rig), number)), "utf-8")
        with desk(
            folder,
            seed=number,
            mesh=MESH,
            rig=(FOLDER / "rig.yaml").read_text("utf-8"),
            sensors=(FOLDER / "places.csv").read_text("utf-8"),
            options=["--y-cable", "--built", "built.yaml", "--sensors", "put.csv"],
        ) as board:
            begin = time.monotonic()
            repeated = board.measure_by_moving(
                "rig.yaml", "--device", "jack:desk", "--sensors", "sensors.csv", "--y-cable",
                "-o", "measured.uff", "--level", _LEVEL,
            )  # fmt: skip
            measure_s = time.monotonic() - begin
            board.run("calibrate", "rig.yaml", "measured.uff", "-o", "calibrated.yaml")
            low, *_, high = frequencies_of(rig)
            board.run(
                "table", "build", "calibrated.yaml", "-o", "table.npz", "--mode", "phased",
                "--frequencies", f"{low:g}:{high:g}:10",
            )  # fmt: skip
            drawn = [*random_fingers(rig, number, count)]
            felt, lost = _felt(board, rig, drawn)
            xruns = board.log_count("XRun")
    real = _with_lags(built)
    touches = tuple(
        Touch(
            len(each.quiet),
            promised_by(each.query(bought)),
            *pair,
            real.contrast(each.query(exact), each.factors),
        )
        for each, pair in zip(drawn, felt, strict=True)
    )
    return Played(Outcome(number, touches), measure_s, repeated, lost, xruns)


def _as_csv(sensors: Sequence[WiredSensor]) -> str:
    """The file of a sensor's places, where it reads the same everywhere."""
    rows = [
        f"{at.name},{at.x},{at.y},{at.input},{1e3 * sensors[0].sensitivity},1,{1e3 * at.mass}"
        for at in sensors
    ]
    return "\n".join(["sensor,x_m,y_m,input,mv_per_m_s2,full_scale_v,mass_g", *rows, ""])


def _with_lags(built: BuiltBoard) -> BuiltBoard:
    """The board with the gains that its drives have in time."""
    truth, frequencies = as_built(built.rig, mesh=MESH), frequencies_of(built.rig)
    eras = tuple(
        replace(
            era,
            gains=tuple(
                (f, abs(gain), float(np.angle(gain)))
                for f, gain in zip(
                    frequencies.tolist(), actuator.response(frequencies).tolist(), strict=True
                )
            ),
        )
        for era, actuator in zip(built.rig.eras, truth.actuators, strict=True)
    )
    return replace(built, rig=replace(built.rig, eras=eras))


def _felt(board: Desk, rig: Rig, drawn: Sequence[Fingers]) -> tuple[list[tuple[float, float]], int]:
    """Contrast promised to touches, and felt [dB]; how many were broken off, and done again."""
    found: list[tuple[float, float]] = []
    lost = 0
    with playing(board, level_db_sl=LEVEL_DB_SL) as era:
        while len(found) < len(drawn):
            fingers = drawn[len(found)]
            places = [fingers.target, *fingers.quiet]
            board.touch_plate(
                [(*at, load) for at, load in zip(places, fingers.factors.tolist(), strict=True)]
            )
            try:
                with era.armed("weekend", lease_s=60):
                    status = hold(era, [*fingers.quiet, fingers.target], _SETTLING)
                    assert status.promised_contrast_db is not None
                    felt = _contrast_felt(board, era, rig, places, status)
                    found.append((status.promised_contrast_db, felt))
                    era.touch([])
            except LeaseLost as problem:
                print(problem, file=sys.stderr, flush=True)
                lost += 1
                if lost > len(drawn):
                    raise RuntimeError("more touches are broken off than played") from problem
                until_ready(era)
    return found, lost


def _contrast_felt(
    board: Desk,
    era: Client,
    rig: Rig,
    places: Sequence[tuple[float, float]],
    status: StatusResult,
) -> float:
    """Contrast that fingers at places feel now, the target first [dB]."""
    board.begin_feeling(_WINDOW)
    end = time.monotonic() + _WINDOW
    while time.monotonic() < end:
        era.touch([*places[1:], places[0]])
        time.sleep(REPEAT)
    felt: FloatArray = board.felt()
    plate = rig.plate
    _, weights = fingertips_on(np.array(places), length=plate.length, width=plate.width)
    found = sizes(felt.reshape(len(felt), -1), status, 48_000 / SAMPLES)
    return felt_contrast(found.reshape(felt.shape[1:]), weights)


def summary(found: Sequence[Played]) -> str:
    """The figures as Markdown."""
    seconds = [each.measure_s for each in found]
    return (
        f"{table([each.outcome for each in found])}\n\n"
        f"Measured in {min(seconds):.0f} to {max(seconds):.0f} s a board; "
        f"{sum(each.repeated for each in found)} times a place was refused, and left out after the "
        "second; "
        f"{sum(each.lost for each in found)} touches broken off and repeated; "
        f"{sum(each.xruns for each in found)} blocks that the server had late."
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.weekend.through_jack", description=__doc__
    )
    parser.add_argument("--boards", type=int, default=10)
    parser.add_argument("--touches", type=int, default=20, help="for each number of quiet fingers")
    parser.add_argument("--first", type=int, default=0, help="number of the first board")
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    found: list[Played] = []
    for number in range(options.first, options.first + options.boards):
        try:
            found.append(played(number, options.touches))
        except RuntimeError as problem:
            print(f"board {number}: {problem}", file=sys.stderr, flush=True)
            continue
        print(summary(found[-1:]), flush=True)
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps([asdict(each) for each in found]), "utf-8")
    if not found:
        sys.exit(1)
    text = summary(found)
    print(f"\n{text}")
    if options.report:
        counts = f"--boards {options.boards} --touches {options.touches}"
        run = f"Printed by `python -m benchmarks.weekend.through_jack {counts} --report`."
        write_parts(PAGE, {"through-jack": f"{run}\n\n{text}"})


if __name__ == "__main__":
    main()
