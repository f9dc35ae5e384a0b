"""How loud boards of the weekend are at most, by kind of board.

    python -m benchmarks.weekend.loudness [--report]

A board that moves as a whole with the peak acceleration of a level, a piston in an infinite wall:
at a distance r the root mean square of its pressure is p = rho a S / (2 pi r), a the root mean
square of the acceleration, at wavelengths above its size (300 Hz: 1.1 m). A real board moves in
parts and radiates from both sides, which takes from that.
"""

import argparse
import math

import numpy as np

from benchmarks.setting import write_parts
from benchmarks.weekend.boards import BOARDS, PAGE
from model.finger import detection_threshold

AIR, DISTANCE, REFERENCE = 1.2, 1.0, 20e-6  # kg/m³, m, Pa
LEVELS, FREQUENCIES = (20, 40), np.arange(100.0, 251.0, 10.0)  # dB SL, Hz


def sound_pressure_level(peak: float, area: float) -> float:
    """Level [dB SPL] at `DISTANCE` of a piston of an area [m²] by its peak acceleration [m/s²]."""
    pressure = AIR * peak / math.sqrt(2) * area / (2 * math.pi * DISTANCE)
    return 20 * math.log10(pressure / REFERENCE)


def table() -> str:
    """The figures as Markdown."""
    rows = [
        f"| board | {' | '.join(f'{level} dB SL' for level in LEVELS)} |",
        f"|---|{'---|' * len(LEVELS)}",
    ]
    for name, rig in {board.name.split()[0]: board.rig for board in BOARDS}.items():
        area, cells = rig.plate.length * rig.plate.width, []
        for level in LEVELS:
            peaks = detection_threshold(FREQUENCIES, rig.threshold) * 10 ** (level / 20)
            loudest = sound_pressure_level(peaks.max(), area)
            cells.append(f"{peaks.min():.2g} to {peaks.max():.2g} m/s², {loudest:.0f} dB SPL")
        size = f"{1000 * rig.plate.length:g} x {1000 * rig.plate.width:g} mm"
        rows.append(f"| {name} {size} | {' | '.join(cells)} |")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.weekend.loudness", description=__doc__
    )
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    print(table())
    if options.report:
        run = "Printed by `python -m benchmarks.weekend.loudness --report`."
        write_parts(PAGE, {"loudness": f"{run}\n\n{table()}"})


if __name__ == "__main__":
    main()
