"""Promises after a change of weather: `python -m benchmarks.promise weather`.

Two contents of 14 dB SL on plates that are solved exactly and drawn within the uncertainty of a
measured rig, all at the far end of the weather that the rig states. Acrylic is 15 K warmer than
when it was measured: its modulus is 6 % lower and its loss factor 18 % higher. Birch has 2 % more
moisture: its modulus is 3 % lower and its density 1.8 % higher. Answers ignore the weather or count
it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.promise.cases import EXAMPLES, IDENTIFIED, LEVEL_DB_SL
from model.answer.answer import Answer
from model.answer.plan import answer
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import ComplexArray, FloatArray, Point
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.rig.rig_writing import change_rig
from model.study.contact_sets import random_contacts
from model.study.exact_plates import Plates, draw_plates, harmonics_on, powers_on
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.vibration import Excitation

MARGIN = 0.02  # m; of fingers from the edge


@dataclass(frozen=True)
class Material:
    """A rig with its weather, its uncertainty without it, and factors of the changed plate."""

    name: str
    rig: Rig
    known: Uncertainty
    modulus: float
    loss: float

    def changed(self, plates: Plates) -> Plates:
        """Return plates at the far end of the weather."""
        return replace(plates, modulus=self.modulus * plates.modulus, loss=self.loss * plates.loss)


def materials() -> list[Material]:
    """Return the rows of the table."""
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
    return [
        Material("acrylic, 4 ERAs identified, 15 K warmer", acrylic, IDENTIFIED, 0.94, 1.18),
        Material(
            "birch, 4 exciters measured, 2 % more moisture", birch, measured, 0.97 / 1.018, 1.0
        ),
    ]


def run(sets: int, plates: int) -> None:
    """Print a row for each material."""
    print("| | ignored: promised, kept | counted: promised, kept |\n|---|---|---|")
    for material in materials():
        limits = material.rig.limits
        stated = replace(material.known, weather=material.rig.uncertainty.weather)
        table = build_table(
            replace(material.rig, uncertainty=stated),
            drive_mode="phased",
            frequencies=np.arange(limits.frequency_min, 301.0, 10.0),
        )
        ignoring = replace(table, uncertainty=material.known)
        cells = [_promised_and_kept(each, material, sets, plates) for each in (ignoring, table)]
        print(f"| {material.name} | {' | '.join(cells)} |", flush=True)


def _promised_and_kept(table: LocalizationTable, material: Material, sets: int, plates: int) -> str:
    def felt(rng: np.random.Generator, best: Answer, positions: Sequence[Point]) -> FloatArray:
        drawn = draw_plates(rng, material.known, count=plates, of=table, contact_count=2)
        return contrasts_on(table, best, positions, material.changed(drawn))

    return promised_and_kept(table, sets, felt)


def promised_and_kept(
    table: LocalizationTable,
    sets: int,
    felt_on_plates: Callable[[np.random.Generator, Answer, Sequence[Point]], FloatArray],
) -> str:
    """Return the median promise of a table to the worse of two fingers, and the share kept.

    felt_on_plates: contrasts [dB] (2, plates) of an answer for fingers at positions [m] on drawn
    plates.
    """
    promises, kept = [], []
    for number in range(sets):
        rng = np.random.default_rng([number, 77])
        positions = random_contacts(rng, 2, table.plate, margin=MARGIN)
        fingers = [Finger(at, Stimulus(LEVEL_DB_SL)) for at in positions]
        best = answer(table, fingers, drive_mode="phased", min_contrast_db=-np.inf)
        promised = np.array([finger.promised_contrast_db for finger in best.fingers], dtype=float)
        felt = felt_on_plates(rng, best, positions)
        promises.append(promised.min())
        kept.append(felt >= promised[:, None])
    return f"{np.median(promises):.1f} dB, {100 * np.mean(kept):.0f} %"


def contrasts_on(
    table: LocalizationTable,
    best: Answer,
    positions: Sequence[tuple[float, float]],
    plates: Plates,
    gains: Callable[[Excitation], ComplexArray] | None = None,
) -> FloatArray:
    """Contrast [dB] of each finger to the other's content on plates, (2, plates).

    gains: further gains (eras,) of the ERAs for an excitation.
    """
    placed = Placement((positions[0],), (positions[1],))
    fingertips = read_fingertips(table, positions)
    powers = []
    for layer in best.layers:
        of_layer = plates
        if gains is not None:
            of_layer = replace(plates, gain=plates.gain * gains(layer.excitation))
        rows, power = powers_on(table, placed, layer.excitation, of_layer)
        thresholds = table.thresholds[rows, None, None].astype(float)
        total = (power / thresholds**2).sum(axis=0)
        total += harmonics_on(table, placed, layer.excitation, of_layer)
        powers.append(total.reshape(2, -1, total.shape[-1]))
    contrasts = []
    for finger in range(2):
        own = fingertips.fine_weights[finger] @ np.sqrt(powers[finger][finger])
        foreign = np.sqrt(powers[1 - finger][finger].max(axis=0))
        contrasts.append(20 * np.log10(own / foreign))
    return np.array(contrasts)
