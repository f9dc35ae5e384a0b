"""Contrast of answers realised on a converged plate, with drives as well as they are known.

    python -m benchmarks.realised [--sets N] [--report]

Of every row the table answers sets of fingers 5 cm apart, from 27 frequencies, at 20 dB SL; its
tones are then played on the plate in polynomials of degree 30, solved at each frequency without
modes. ERAs deviate as the row's uncertainty says, nothing else does. Of 400 plates so drawn the
median counts, at the loudest of 17 points under each quiet finger; of the sets the median. With
--report, the page docs/measured/contrast-benchmark.md is written as well.
"""

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.identification.plates import DRIVES, FREQUENCIES
from benchmarks.setting import RIG, random_contacts, write_parts
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import FloatArray
from model.finger import DiscRule, decibels, detection_threshold, fingertips_on
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.spectral.direct_solution import direct_spectral_acceleration
from model.spectral.modes import SpectralMesh
from model.structure.attachments import fingertip_loads
from model.study.verification import draw_plates
from model.table.table_file import build_table
from model.vibration import Excitation, base_amplitudes

PAGE = Path(__file__).parents[1] / "docs" / "measured" / "contrast-benchmark.md"
QUIET = (1, 2, 3)
SEED, DRAWS, DEGREE = 30, 400, 30
MARGIN = 0.013  # m; so that no edge cuts a fingertip


@dataclass(frozen=True)
class Row:
    """A rig in a drive mode: error of gains, degrees a hundredfold; whether fingers load it.

    goals [dB]: with one, two and three quiet fingers.
    """

    title: str
    rig: str
    error: float
    goals: tuple[float, float, float]
    drive_mode: str = "phased"
    is_loaded: bool = False


ROWS = (
    Row("eight ERAs, 1 %", "eight_eras", 0.01, (40.5, 27.5, 19.8)),
    Row("eight ERAs, 5 %", "eight_eras", 0.05, (29.2, 19.9, 15.7)),
    Row("four ERAs, 1 %", "paper_plate", 0.01, (33.8, 18.0, 14.5)),
    Row(
        "four ERAs, 1 %, fingers load them", "paper_plate", 0.01, (33.0, 17.8, 14.1), is_loaded=True
    ),
    Row("four ERAs, 5 %, `switched`", "paper_plate", 0.05, (15.2, 9.15, 5.9), "switched"),
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.realised")
    parser.add_argument("--sets", type=int, default=30, help="for each number of quiet fingers")
    parser.add_argument("--report", action="store_true")
    options = parser.parse_args()
    lines = [
        "| drives known to | realised | goal | nine of ten | promise kept | least level |",
        "|---|---|---|---|---|---|",
    ]
    for row in ROWS:
        lines.append(_line(row, options.sets))
        print(lines[-1], flush=True)
    if options.report:
        run = f"python -m benchmarks.realised --sets {options.sets} --report"
        table = "\n".join(lines)
        write_parts(PAGE, {"realised": f"Printed by `{run}`.\n\n{table}"})


def _line(row: Row, sets: int) -> str:
    """A line of the table: medians over sets, and over all draws."""
    rig = load_rig(RIG.parent / f"{row.rig}.yaml")
    known = replace(DRIVES, gain=row.error, phase_deg=100 * row.error)
    fingertip = rig.fingertip if row.is_loaded else None
    rig = replace(rig, uncertainty=known, fingertip=fingertip)
    table = build_table(rig, frequencies=FREQUENCIES, drive_mode=row.drive_mode)
    medians, tenths, kept, levels = [], [], [], []
    for quiet in QUIET:
        rng = np.random.default_rng([SEED, quiet])
        found = []
        for number in range(sets):
            size = (rig.plate.length, rig.plate.width)
            target, *others = random_contacts(rng, 1 + quiet, size, margin=MARGIN).tolist()
            asked = Placement((tuple(target),), tuple(map(tuple, others)))
            answer = query(table, asked)
            contrast, level = realised(rig, asked, answer.layers[0].excitation, number)
            found.append([*np.percentile(contrast, [50, 10]), np.percentile(level, 10)])
            promised = answer.fingers[0].promised_contrast_db
            assert promised is not None
            kept.append((contrast >= promised).mean())
        median, tenth, level = np.transpose(found)
        medians.append(f"{np.median(median):.1f}")
        tenths.append(f"{np.median(tenth):.1f}")
        levels.append(level.min())
    return (
        f"| {row.title} | {' / '.join(medians)} | {' / '.join(map(str, row.goals))} | "
        f"{' / '.join(tenths)} | {100 * np.mean(kept):.0f} % | {min(levels):.1f} |"
    )


def realised(
    rig: Rig, asked: Placement, excitation: Excitation, number: int
) -> tuple[FloatArray, FloatArray]:
    """Felt contrast [dB] and level [dB SL] on plates (d,), drawn by the number of the set."""
    plate, eras = rig.plate, rig.eras
    around = np.exp(0.25j * np.pi * np.arange(8))
    at = np.concatenate([[0], np.sqrt(0.5) * around, around])
    rule = DiscRule(np.column_stack([at.real, at.imag]), np.repeat([4, 2, 0.5], [1, 8, 8]) / 24)
    discs, weights = fingertips_on(
        np.array(asked.contacts), length=plate.length, width=plate.width, rule=rule
    )
    frequencies, bases = base_amplitudes(excitation, eras)
    unit = direct_spectral_acceleration(
        plate,
        SpectralMesh(DEGREE, DEGREE, plate.length, plate.width),
        eras,
        frequencies,
        discs.reshape(-1, 2),
        loads=fingertip_loads(rig.fingertip, asked.contacts),
    )
    plates = draw_plates(
        np.random.default_rng([SEED, number, len(asked.quiet)]),
        rig.uncertainty,
        count=DRAWS,
        of=rig,
        contact_count=len(asked.contacts),
    )
    shares = bases / [era.full_level for era in eras]
    fields = np.einsum("fe,de,fep->fdp", shares, plates.gain, unit)
    sensed = np.abs(fields) / detection_threshold(frequencies, rig.threshold)[:, None, None]
    total = np.sqrt((sensed**2).sum(axis=0)).reshape(DRAWS, *weights.shape)
    level = total[:, 0] @ weights[0]
    return decibels(level / total[:, 1:].max(axis=(1, 2))), decibels(level)


if __name__ == "__main__":
    main()
