"""What the radius of a fingertip is worth: contrast by the radius that is answered and judged.

    python -m benchmarks.localization.radius [--sets 60]

On the paper's plate, mode phased, weightless fingers, no errors: median contrast of answers for
discs of a radius, judged on discs of that radius, and of the answers for 13 mm judged on smaller
ones.
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache

import numpy as np

from benchmarks.localization.cases import FREQUENCIES, contact_sets, question_of
from benchmarks.setting import RIG, use_one_thread
from model.arrays import FloatArray
from model.finger import fingertip
from model.finger.perception import contrast_db
from model.rig.file import load_rig
from model.rig.uncertainty import Uncertainty
from model.table.build import build_table
from model.table.table import LocalizationTable

RADII = (0.005, 0.0075, 0.010, 0.013)
QUIET = (1, 2, 3)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.localization.radius")
    parser.add_argument("--sets", type=int, default=60)
    sets = parser.parse_args().sets
    use_one_thread()
    print(f"median contrast in dB, {sets} sets each   1 / 2 / 3 quiet fingers")
    for radius in RADII:
        found = [_median(sets, quiet, answered=radius, judged=radius) for quiet in QUIET]
        print(f"answered and judged on {1000 * radius:4.1f} mm        {_row(found)}")
    for radius in RADII[:-1]:
        found = [_median(sets, quiet, answered=RADII[-1], judged=radius) for quiet in QUIET]
        print(f"answered on 13 mm, judged on {1000 * radius:4.1f} mm  {_row(found)}")


def _row(found: list[float]) -> str:
    return " / ".join(f"{each:4.1f}" for each in found)


def _median(sets: int, quiet: int, *, answered: float, judged: float) -> float:
    places = contact_sets(sets, fingers=1 + quiet, rng=np.random.default_rng(quiet))
    return float(np.median([_contrast(each, answered, judged) for each in places]))


def _contrast(places: FloatArray, answered: float, judged: float) -> float:
    """Contrast [dB] of the answer for discs of one radius [m] on discs of another."""
    table = _table(answered)
    with _radius(answered):
        pattern = table.query(question_of(places, drive_mode="phased"))
    with _radius(judged):
        points, weights = fingertip.fingertips_on(
            places, length=table.plate.length, width=table.plate.width
        )
    peak = table.amplitudes(pattern.excitation, points.reshape(-1, 2))[1].sum(axis=0)
    target, *quiet = peak.reshape(len(places), -1)
    return float(contrast_db([target], np.concatenate(quiet), [weights[0]]))


@cache
def _table(radius: float) -> LocalizationTable:
    """A table for discs of this radius [m]: what it has read of a place it keeps."""
    with _radius(radius):
        rig = replace(load_rig(RIG), fingertip=None, uncertainty=Uncertainty.none())
        return build_table(rig, frequencies=FREQUENCIES)


@contextmanager
def _radius(radius: float) -> Iterator[None]:
    usual = fingertip.FINGERTIP_RADIUS
    fingertip.FINGERTIP_RADIUS = radius
    try:
        yield
    finally:
        fingertip.FINGERTIP_RADIUS = usual


if __name__ == "__main__":
    main()
