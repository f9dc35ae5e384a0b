"""Whether what is promised of a click is kept, on plates that deviate and vibrate in time.

    python -m benchmarks.promise.clicks [--only RIG ...] [--sets 60] [--plates 4] [--seed 20]

Clicks of 40 ms and 20 dB SL along plain ramps, fingers anywhere on the plate, 5 cm apart, one to
three of them quiet. On other plates for each set, drawn within the uncertainty of the rig (default)
or one as after `era rig identify` (identified), the contrast over the click: at the target over its
duration, at the loudest quiet point the strongest as long, ringing after it included. Median of
what is promised, share of all plates that give it, and by how much it is beyond what nine of ten
of them give [dB].
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.promise.cases import EXAMPLES, IDENTIFIED
from model.answer.answer import Answer
from model.answer.plan import query
from model.answer.promise import RingingUnderFingers
from model.answer.stimulus import DriveEnvelope, Placement
from model.arrays import ComplexArray, FloatArray
from model.finger import fingertip_points, fingertip_weights
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.study.contrast_maps import random_contacts
from model.study.verification import draw_plates
from model.table.table import LocalizationTable
from model.table.table_file import build_table, table_following
from model.vibration import Tone, base_amplitudes

RIGS = ("paper_plate", "eight_eras", "car_display", "table")
DURATION, LEVEL_DB_SL = 0.04, 20.0

Clicks = list["Answer"]


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.promise.clicks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", metavar="RIG", default=RIGS)
    parser.add_argument("--sets", type=int, default=60)
    parser.add_argument("--plates", type=int, default=4)
    parser.add_argument("--seed", type=int, default=20)
    options = parser.parse_args()

    print("| rig | uncertainty | promised [dB] | kept | beyond nine of ten [dB] |")
    print("|---|---|---|---|---|")
    for name in options.only:
        written = load_rig(EXAMPLES / f"{name}.yaml")
        for label, known in (("default", written.uncertainty), ("identified", IDENTIFIED)):
            rig = replace(written, uncertainty=known)
            table = build_table(rig, drive_mode="phased")
            clicks = clicks_on(table, options.sets, options.seed)
            promised = np.array([each.fingers[0].promised_contrast_db for each in clicks])
            found = np.concatenate(
                [
                    given(table, rig, [click], options.plates, options.seed + number)
                    for number, click in enumerate(clicks, start=1)
                ]
            )
            above = found - promised[:, None]
            print(
                f"| `{name}` | {label} | {np.median(promised):.1f} | "
                f"{100 * np.mean(above >= 0):.0f} % of {above.size} | "
                f"{-np.percentile(above, 10):+.1f} |",
                flush=True,
            )


def clicks_on(table: LocalizationTable, sets: int, seed: int) -> Clicks:
    """What is played for a click with one to three quiet fingers in turn."""
    rng, found = np.random.default_rng(seed), []
    for number in range(sets):
        places = random_contacts(rng, 2 + number % 3, table.plate, margin=0.013)
        placed = Placement(places[:1], places[1:])
        found.append(query(table, placed, LEVEL_DB_SL, duration=DURATION, drive_mode="phased"))
    return found


def given(
    table: LocalizationTable, rig: Rig, answers: Sequence[Answer], plates: int, seed: int
) -> FloatArray:
    """Contrast [dB] of the first finger on plates that differ from a rig's within its uncertainty.

    Of each answer (a, plates): its level above the others' content at it, or of an only content
    above what is felt of it at the loudest other finger.
    """
    found = np.empty((len(answers), plates))
    for number, drawn in enumerate(_drawn_plates(table, rig, plates, seed)):
        for row, each in enumerate(answers):
            own, *others = (_felt_on(*drawn, each, layer) for layer in range(len(each.layers)))
            heard = sum(power[0] for _, power in others) if others else own[1][1:].max()
            found[row, number] = 10 * math.log10(own[0] / heard)
    return found


def _drawn_plates(
    table: LocalizationTable, rig: Rig, plates: int, seed: int
) -> Iterator[tuple[LocalizationTable, ComplexArray, ComplexArray]]:
    """The table of each plate, and gains and second harmonics of its drives (eras,)."""
    drawn = draw_plates(
        np.random.default_rng(seed),
        rig.uncertainty,
        count=plates,
        of=rig,
        contact_count=1,
    )
    for number in range(plates):
        factor, finger = float(drawn.thickness[number]), rig.fingertip
        eras = tuple(
            replace(
                era,
                x=min(max(era.x + x, 0.0), rig.plate.length),
                y=min(max(era.y + y, 0.0), rig.plate.width),
                stiffness=k * era.stiffness,
                damping=drawn.damping[number] * era.damping,
            )
            for era, k, (x, y) in zip(
                rig.eras,
                drawn.stiffness[number].tolist(),
                drawn.places[number].tolist(),
                strict=True,
            )
        )
        plate = replace(
            rig.plate.scaled(modulus=float(drawn.modulus[number])),
            thickness=factor * rig.plate.thickness,
            loss_factor=float(drawn.loss[number]) * rig.plate.loss_factor,
        )
        load = float(drawn.load[number, 0])
        other = replace(rig, plate=plate, eras=eras, fingertip=finger and finger.multiplied(load))
        yield table_following(table, other), drawn.gain[number], drawn.harmonic[number]


def _felt_on(
    table: LocalizationTable,
    gains: ComplexArray,
    harmonic: ComplexArray,
    answer: Answer,
    number: int,
) -> tuple[float, FloatArray]:
    """Power to threshold of a layer at its first finger, and at the loudest points of all (k,).

    In time: over a duration, or at the strongest moments of a course; of what lasts the steady one.
    """
    contents, power = answer.contents, 0.0
    steady = RingingUnderFingers(
        table, contents.places, contents.loads, DriveEnvelope(np.ones(2), 1e-3, 1, share=0.0)
    )
    over = RingingUnderFingers.of_streams(table, contents)[number] or steady
    target, heard = contents.streams[number].targets[0], np.zeros(len(contents.places))
    points = fingertip_points(*contents.places[target], table.plate)
    weights = fingertip_weights(*contents.places[target], table.plate)
    by_name = dict(zip((era.name for era in table.eras), gains.tolist(), strict=True))
    for excitation in answer.layers[number].excitations:
        tones = {
            name: Tone.from_phasor(tone.frequency, tone.phasor * by_name[name])
            for name, tone in excitation.items()
        }
        hertz, bases = base_amplitudes(tones, table.eras)
        frequencies, amplitudes = table.amplitudes(tones, points, contacts=contents.places)
        thresholds = table.thresholds[table.rows_of(frequencies), None]
        level = float(np.linalg.norm(amplitudes / thresholds, axis=0) @ weights)
        played = over.over(zip(hertz.tolist(), bases, strict=True))
        harmonics = over.over(zip((2 * hertz).tolist(), bases * harmonic, strict=True))
        power += (level * float(played.gains[target])) ** 2
        heard += (played.heard + harmonics.heard).max(axis=1)
    return power, heard


if __name__ == "__main__":
    main()
