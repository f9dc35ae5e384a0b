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
from dataclasses import replace
from typing import TYPE_CHECKING

from benchmarks.setting import use_one_thread

if TYPE_CHECKING:
    from model.answer.answer import Answer
    from model.arrays import FloatArray
    from model.rig.rig import Rig
    from model.table.table import LocalizationTable

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
    use_one_thread()
    import numpy as np

    from benchmarks.promise.cases import EXAMPLES, IDENTIFIED
    from model.rig.file import load_rig
    from model.table.build import build_table

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


def clicks_on(table: "LocalizationTable", sets: int, seed: int) -> Clicks:
    """What is played for a click with one to three quiet fingers in turn."""
    import numpy as np

    from model.answer.fingers import Placement
    from model.answer.plan import query
    from model.study.random_contacts import random_contacts

    rng, found = np.random.default_rng(seed), []
    for number in range(sets):
        places = random_contacts(rng, 2 + number % 3, table.plate, margin=0.013)
        placed = Placement(places[:1], places[1:])
        found.append(query(table, placed, LEVEL_DB_SL, duration=DURATION, drive_mode="phased"))
    return found


def given(
    table: "LocalizationTable", rig: "Rig", clicks: Clicks, plates: int, seed: int
) -> "FloatArray":
    """Contrast [dB] over clicks on plates that differ from a rig's within its uncertainty."""
    import numpy as np

    from model.answer.over_duration import DriveEnvelope, RingingUnderFingers
    from model.finger.fingertip import fingertip_points, fingertip_weights
    from model.study.exact_plates import draw_plates
    from model.table.following import table_following
    from model.vibration.excitation import Tone, base_amplitudes

    drawn = draw_plates(
        np.random.default_rng(seed),
        rig.uncertainty,
        count=plates,
        era_count=len(rig.eras),
        contact_count=1,
    )
    found = np.empty((len(clicks), plates))
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
        other = table_following(
            table,
            replace(rig, plate=plate, eras=eras, fingertip=finger and finger.multiplied(load)),
        )
        gains = dict(zip((era.name for era in eras), drawn.gain[number], strict=True))
        for row, click in enumerate(clicks):
            (layer,), contacts = click.layers, click.contents.places
            tones = {
                name: Tone(tone.frequency, abs(z := tone.phasor * gains[name]), float(np.angle(z)))
                for name, tone in layer.excitation.items()
            }
            envelope = DriveEnvelope.of_pulse(DURATION, layer.ramp)
            ringing = RingingUnderFingers(other, contacts, (), envelope)
            hertz, bases = base_amplitudes(tones, eras)
            pulse = ringing.over(zip(hertz.tolist(), bases, strict=True))
            frequencies, amplitudes = other.amplitudes(
                tones, fingertip_points(*contacts[0], plate), contacts=contacts
            )
            threshold = other.thresholds[other.rows_of(frequencies)]
            steady = np.linalg.norm(amplitudes / threshold[:, None], axis=0)
            level = 20 * math.log10(float(steady @ fingertip_weights(*contacts[0], plate)))
            distorted = bases * drawn.harmonic[number]
            harmonics = ringing.over(zip((2 * hertz).tolist(), distorted, strict=True))
            quiet = 10 * math.log10(float((pulse.heard + harmonics.heard)[1:].max()))
            found[row, number] = level + 20 * math.log10(float(pulse.gains[0])) - quiet
    return found


if __name__ == "__main__":
    main()
