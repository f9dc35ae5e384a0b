"""What fingers feel of answers on plates that deviate, each solved exactly at the tones played."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from model.answer.answer import Answer
from model.answer.stimulus import Placement
from model.arrays import FloatArray, Point
from model.finger import detection_threshold
from model.study.verification import Plates, harmonics_on, powers_on
from model.table.table import LocalizationTable, read_fingertips
from model.vibration import Excitation


@dataclass(frozen=True)
class Realised:
    """Levels [dB SL] of fingers as asked, on d plates: of their own content and of all else.

    own (fingers, d): means over fingertips, NaN without a content; foreign (fingers, d): at the
    loudest points.
    """

    own: FloatArray
    foreign: FloatArray

    @property
    def contrast(self) -> FloatArray:
        """Contrast (fingers, d) [dB]: at quiet fingers that of the weakest content."""
        weakest = np.nanmin(self.own, axis=0)
        return np.where(np.isnan(self.own), weakest, self.own) - self.foreign


def realised(
    table: LocalizationTable,
    found: Answer,
    plates: Plates,
    *,
    threshold: str | None = None,
    resting: Sequence[Point] = (),
    loads: Sequence[float] = (),
    late: FloatArray | None = None,
) -> Realised:
    """Solve an answer on plates, drawn for as many contacts as it has.

    threshold: another set than the table's; resting: places of what lies in the stead of quiet
    fingers, with a load for each contact; late (d, eras): delays of the drives [s].
    """
    layers = [each.layer for each in found.fingers]
    places = [each.at for each in found.asked]
    if resting:
        places = [at for at, layer in zip(places, layers, strict=True) if layer is not None]
        layers = [*range(len(places)), *[None] * len(resting)]
    placed = Placement((*places, *resting), (), tuple(loads))
    weights = read_fingertips(table, placed.contacts).fine_weights

    def sensed(tones: Excitation) -> FloatArray:
        """Power to threshold at all fine points of the fingers, (fingers, points, d)."""
        frequency = next(iter(tones.values())).frequency
        drives = plates
        if late is not None:
            drives = replace(plates, gain=plates.gain * np.exp(-2j * np.pi * frequency * late))
        rows, power = powers_on(table, placed, tones, drives)
        hertz, name = table.frequencies[rows], threshold or table.threshold
        felt = (power / detection_threshold(hertz, name)[:, None, None] ** 2).sum(axis=0)
        own, other = (detection_threshold(2 * hertz[0], each) for each in (table.threshold, name))
        felt += (own / other) ** 2 * harmonics_on(table, placed, tones, drives)
        return felt.reshape(*weights.shape, -1)

    power = np.array([sum(map(sensed, (one.excitation, *one.side_bands))) for one in found.layers])
    levels, foreign = [], []
    for finger, layer in enumerate(layers):
        mine = np.arange(len(power)) == layer
        levels.append(weights[finger] @ np.sqrt(power[mine, finger].sum(axis=0)))
        foreign.append(power[~mine, finger].sum(axis=0).max(axis=0))
    own = np.where(np.equal(layers, None)[:, None], np.nan, levels)
    return Realised(20 * np.log10(own), 10 * np.log10(np.maximum(foreign, 1e-12)))
