"""Whether promises of two contents are kept on plates with harmonics and with further errors.

    python -m benchmarks.promise.errors [--sets 16] [--plates 80] [--place 0.001]

Contents of 14 dB SL, fingers anywhere on the plate, 5 cm apart, on plates solved exactly and drawn
within the uncertainty of the rig (default) or one as after `era rig identify` (identified): with
none of the harmonics, modulus and places; with 1 % of second harmonic; and with all. Share of the
promises that are kept where answers do not count these errors and where they do, and the promise at
the worst finger, median. With --place ERAs are known to so much [m], and all errors are there.
"""

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

from benchmarks.setting import use_one_thread

if TYPE_CHECKING:
    from model.answer.answer import Answer
    from model.arrays import FloatArray
    from model.study.verification import Plates
    from model.table.table import LocalizationTable


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.promise.errors",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--sets", type=int, default=16)
    parser.add_argument("--plates", type=int, default=80)
    parser.add_argument("--place", type=float)
    options = parser.parse_args()
    use_one_thread()
    import numpy as np

    from benchmarks.promise.cases import CASES
    from model.answer.plan import answer
    from model.answer.stimulus import Finger, Stimulus
    from model.study.contrast_maps import random_contacts
    from model.study.verification import draw_plates

    print("| | not counted: promised | kept | counted: promised | kept |")
    print("|---|---|---|---|---|")
    for case in [each for each in CASES if each.with_errors]:
        known = case.rig.uncertainty
        if options.place is not None:
            if case.without:
                continue
            known = replace(known, place=options.place)
        least = replace(known, modulus=0.0, place=0.0, harmonic=0.0)
        cells = []
        for counted in (least, known):
            table, kept, promised = replace(case.table, uncertainty=counted), [], []
            for number in range(options.sets):
                rng = np.random.default_rng([number, 77])
                places = random_contacts(rng, 2, table.plate, margin=0.013)
                fingers = [Finger(at, Stimulus(14.0)) for at in places]
                found = answer(table, fingers, drive_mode="phased", min_contrast_db=-np.inf)
                plates = draw_plates(rng, known, count=options.plates, of=table, contact_count=2)
                contrasts = np.array([each.promised_contrast_db for each in found.fingers])
                kept.append(contrasts_on(table, found, plates) >= contrasts[:, None])
                promised.append(contrasts.min())
            cells.append(f"{np.median(promised):.1f} dB | {100 * np.mean(kept):.0f} %")
        print(f"| {case.title} | {' | '.join(cells)} |", flush=True)


def contrasts_on(table: "LocalizationTable", found: "Answer", plates: "Plates") -> "FloatArray":
    """Contrast of each finger to the other's content on plates [dB], (2, d)."""
    import numpy as np

    from model.answer.stimulus import Placement
    from model.study.verification import harmonics_on, powers_on
    from model.table.table import read_fingertips

    places = [each.at for each in found.asked]
    placed, tips = Placement((places[0],), (places[1],)), read_fingertips(table, places)
    powers = []
    for layer in found.layers:
        rows, power = powers_on(table, placed, layer.excitation, plates)
        power = (power / table.thresholds[rows, None, None].astype(float) ** 2).sum(axis=0)
        power += harmonics_on(table, placed, layer.excitation, plates)
        powers.append(power.reshape(2, -1, power.shape[-1]))
    own = [tips.fine_weights[j] @ np.sqrt(powers[j][j]) for j in range(2)]
    return np.array(
        [20 * np.log10(own[j] / np.sqrt(powers[1 - j][j].max(axis=0))) for j in range(2)]
    )


if __name__ == "__main__":
    main()
