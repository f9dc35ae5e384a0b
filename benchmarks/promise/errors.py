"""Whether promises of two contents are kept on plates with harmonics and with further errors.

    python -m benchmarks.promise.errors [--sets 16] [--plates 80] [--place 0.001] [--weather]

Contents of 14 dB SL, fingers anywhere on the plate, 5 cm apart, on plates solved exactly and drawn
within the uncertainty of the rig (default) or one as after `era rig identify` (identified): with
none of the harmonics, modulus and places; with 1 % of second harmonic; and with all. Share of the
promises that are kept where answers do not count these errors and where they do, and the promise at
the worst finger, median. With --place ERAs are known to so much [m], and all errors are there.

With --weather all plates are at the far end of the weather that their rig states, whose cost
answers count or do not: acrylic 15 K warmer than as it was measured, its modulus lower by 6 % and
its loss factor higher by 18 %; birch with 2 % more of moisture, its modulus lower by 3 % and its
density higher by 1.8 %; fingers 2 cm from the edge.
"""

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from benchmarks.promise.cases import CASES, EXAMPLES, IDENTIFIED
from model.answer.answer import Answer
from model.answer.plan import answer
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import FloatArray
from model.rig.rig import Uncertainty
from model.rig.rig_file import load_rig
from model.rig.rig_writing import change_rig
from model.study.contrast_maps import random_contacts
from model.study.verification import Plates, draw_plates, harmonics_on, powers_on
from model.table.table import LocalizationTable, read_fingertips
from model.table.table_file import build_table


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.promise.errors",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--sets", type=int, default=16)
    parser.add_argument("--plates", type=int, default=80)
    parser.add_argument("--place", type=float)
    parser.add_argument("--weather", action="store_true")
    options = parser.parse_args()
    size = options.sets, options.plates
    print("| | not counted: promised | kept | counted: promised | kept |")
    print("|---|---|---|---|---|")
    rows = after_weather(*size) if options.weather else with_errors(*size, options.place)
    for title, cells in rows:
        print(f"| {title} | {' | '.join(cells)} |", flush=True)


def with_errors(sets: int, count: int, place: float | None) -> Iterator[tuple[str, list[str]]]:
    """Yield rows of plates with harmonics and further errors; place [m]: of ERAs, if given."""
    for case in [each for each in CASES if each.with_errors]:
        known = case.rig.uncertainty
        if place is not None:
            if case.without:
                continue
            known = replace(known, place=place)
        least = replace(known, modulus=0.0, place=0.0, harmonic=0.0)
        tables = [replace(case.table, uncertainty=each) for each in (least, known)]
        yield case.title, [kept_by(each, known, sets, count) for each in tables]


def after_weather(sets: int, count: int) -> Iterator[tuple[str, list[str]]]:
    """Yield rows of plates that were measured, after the weather has changed."""
    acrylic = change_rig(
        load_rig(EXAMPLES / "paper_plate.yaml"),
        plate={
            "material": "acrylic",
            "thickness": 0.004,
            "temperature": ["23 degC", "38 degC"],
            "measured_temperature": "23 degC",
        },
    )
    birch = change_rig(
        load_rig(EXAMPLES / "weekend" / "rig.yaml"),
        plate={"humidity": ["50 %", "61 %"], "measured_humidity": "50 %"},
    )
    measured = Uncertainty(0.01, 0.6, stiffness=0.01, damping=1.02, place=0.0, supports=0.05)
    measured = replace(measured, **Uncertainty.of_frequency(0.01))
    for title, rig, known, modulus, loss in (
        ("acrylic, 4 ERAs identified, 15 K warmer", acrylic, IDENTIFIED, 0.94, 1.18),
        ("birch, 4 exciters measured, 2 % more moisture", birch, measured, 0.97 / 1.018, 1.0),
    ):
        stated = replace(known, weather=rig.uncertainty.weather)
        grid = np.arange(rig.limits.frequency_min, 301.0, 10.0)
        whole = replace(rig, uncertainty=stated)
        table = build_table(whole, drive_mode="phased", frequencies=grid)

        def changed(plates: Plates, modulus: float = modulus, loss: float = loss) -> Plates:
            return replace(plates, modulus=modulus * plates.modulus, loss=loss * plates.loss)

        tables = [replace(table, uncertainty=each) for each in (known, stated)]
        yield title, [kept_by(each, known, sets, count, 0.02, changed) for each in tables]


def kept_by(
    table: LocalizationTable,
    known: Uncertainty,
    sets: int,
    count: int,
    margin: float = 0.013,
    changed: Callable[[Plates], Plates] = lambda plates: plates,
) -> str:
    """Return cells of what is promised and kept on plates of an uncertainty, changed after."""
    kept, promised = [], []
    for number in range(sets):
        rng = np.random.default_rng([number, 77])
        places = random_contacts(rng, 2, table.plate, margin=margin)
        fingers = [Finger(at, Stimulus(14.0)) for at in places]
        found = answer(table, fingers, drive_mode="phased", min_contrast_db=-np.inf)
        plates = changed(draw_plates(rng, known, count=count, of=table, contact_count=2))
        contrasts = np.array([each.promised_contrast_db for each in found.fingers])
        kept.append(contrasts_on(table, found, plates) >= contrasts[:, None])
        promised.append(contrasts.min())
    return f"{np.median(promised):.1f} dB | {100 * np.mean(kept):.0f} %"


def contrasts_on(table: LocalizationTable, found: Answer, plates: Plates) -> FloatArray:
    """Contrast of each finger to the other's content on plates [dB], (2, d)."""
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
