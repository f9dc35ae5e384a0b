"""Places that are off: of ERAs by the direct solve, of exciters by the plates they stand on."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.direct_plate import direct_acceleration
from benchmarks.setting import random_contacts
from model.answer.stimulus import Placement
from model.arrays import ComplexArray
from model.fem import assemble
from model.rig.rig import Uncertainty
from model.rig.rig_file import load_rig
from model.study.verification import draw_plates, felt_on
from model.table.table_file import build_table
from plates import smooth_rig
from set_table import only

WEEKEND = Path(__file__).parents[3] / "examples" / "weekend" / "rig.yaml"
FREQUENCIES = np.array([60.0, 145.0, 260.0])
PLACES = ((0.05, 0.04), (0.26, 0.06), (0.24, 0.19), (0.13, 0.12))
STEP, STIFFER = 1e-4, 1e-3  # m, relative


def test_places_that_are_off_change_fields_as_much_as_stiffnesses_do() -> None:
    """All fields over the plate, mean square: an ERA off by 1 mm along x and y, and its spring."""
    plain = smooth_rig()
    eras = tuple(replace(era, x=x, y=y) for era, (x, y) in zip(plain.eras, PLACES, strict=True))
    known = replace(Uncertainty.none(), stiffness=0.01, place=0.001)
    rig = replace(plain, eras=eras, uncertainty=known)
    table = build_table(rig, frequencies=FREQUENCIES)
    matrices = assemble(rig.plate, rig.mesh)

    def changed(number: int, **values: float) -> ComplexArray:
        other = replace(rig.eras[number], **values)
        every = [*rig.eras[:number], other, *rig.eras[number + 1 :]]
        return direct_acceleration(matrices, every, FREQUENCIES, table.raster.points)

    for number, era in enumerate(rig.eras):
        moved = [
            (changed(number, x=era.x + x, y=era.y + y) - changed(number, x=era.x - x, y=era.y - y))
            / (2 * STEP)
            for x, y in ((STEP, 0.0), (0.0, STEP))
        ]
        k = era.stiffness
        stiffer = changed(number, stiffness=k * (1 + STIFFER))
        softer = changed(number, stiffness=k * (1 - STIFFER))
        by_place = 0.001**2 * (np.abs(moved) ** 2).sum(axis=(0, 2, 3))
        by_spring = (np.abs((stiffer - softer) / (2 * STIFFER * k)) ** 2).sum(axis=(1, 2))
        expected = np.hypot(0.01 * k, np.sqrt(by_place / by_spring))
        found = table.on_eras.plate.by_stiffness[:, number].real
        np.testing.assert_allclose(found, expected, rtol=0.03)


def test_promises_of_exciters_whose_places_are_off_are_kept_on_nine_of_ten_plates() -> None:
    """On 60 plates each, solved with exciters where they stand, 24 answers: 86 to 96 % of all.

    Counted as errors of stiffnesses alone two of three and less keep them.
    """
    known = replace(Uncertainty.none(), gain=0.01, place=0.001)
    rig = replace(load_rig(WEEKEND), uncertainty=known)
    table = build_table(rig, frequencies=np.arange(100.0, 301.0, 25.0), drive_mode="phased")
    rng, kept = np.random.default_rng(3), []
    for _ in range(24):
        target, quiet = random_contacts(rng, 2, (0.4, 0.3), margin=0.02).tolist()
        placed = Placement((tuple(target),), (tuple(quiet),))
        layer, promise = only(table, placed, drive_mode="phased")
        plates = draw_plates(rng, known, of=rig, count=60, contact_count=2)
        contrast = felt_on(table, placed, layer.excitation, plates).contrast
        assert contrast is not None
        assert promise.promised_contrast_db is not None
        kept.append(20 * np.log10(contrast) >= promise.promised_contrast_db)
    assert 0.86 <= np.mean(kept) <= 0.96
