"""Places of ERAs that are off, as errors of their stiffnesses, by the direct solve."""

from dataclasses import replace

import numpy as np

from benchmarks.direct_plate import direct_acceleration
from model.arrays import ComplexArray
from model.fem.plate import assemble
from model.rig.uncertainty import Uncertainty
from model.table.build import build_table
from paper_table import smooth_rig

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
