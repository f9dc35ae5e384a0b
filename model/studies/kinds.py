"""The three studies: what each of them compares."""

from collections.abc import Callable

import numpy as np

from model.counting import counted
from model.errors import InputError
from model.rig.rig import Rig
from model.studies.cases import Cases, all_alike
from model.studies.pool import LayoutPool

STIFFNESS_FACTORS = 2.0 ** np.arange(-4, 5)
"""A stiffness study multiplies the stiffness of the rig's ERAs by 1/16 to 16."""

MOST_ERAS = 6
"""A count study goes from one ERA to so many."""


def placement_cases(rig: Rig, *, layouts: int, seed: int, raster: tuple[int, int]) -> Cases:
    """The rig's ERAs in other places: its own layout, those with a name, random ones."""
    if layouts < 1:
        raise InputError(f"{layouts} layouts are none to study; ask for one at least")
    pool = LayoutPool(rig, raster)
    pool.add(len(rig.eras), layouts, np.random.default_rng(seed), own=True)
    return pool.cases()


def count_cases(rig: Rig, *, layouts: int, seed: int, raster: tuple[int, int]) -> Cases:
    """One to MOST_ERAS ERAs like the rig's, the layouts shared out evenly among the counts."""
    if not all_alike(rig.eras):
        raise InputError(
            "the rig's ERAs differ, so more or fewer of them cannot be told; give all of them the "
            "same stiffness, damping, bolt_mass and stroke for a study of their count"
        )
    most = max(MOST_ERAS, len(rig.eras))
    if layouts < most:
        raise InputError(
            f"{counted(layouts, 'layout')} cannot compare 1 to {most} ERAs; ask for at least {most}"
        )
    pool = LayoutPool(rig, raster)
    rng = np.random.default_rng(seed)
    for count in range(1, most + 1):
        share = layouts // most + (count <= layouts % most)
        pool.add(count, share, rng, own=count == len(rig.eras))
    return pool.cases()


def stiffness_cases(rig: Rig, *, layouts: int, seed: int, raster: tuple[int, int]) -> Cases:
    """Every layout of a placement study with each of the STIFFNESS_FACTORS."""
    placed = placement_cases(rig, layouts=layouts, seed=seed, raster=raster)
    count = len(STIFFNESS_FACTORS)
    return Cases(
        placed.positions,
        np.repeat(placed.places, count, axis=0),
        np.tile(STIFFNESS_FACTORS, len(placed)),
        tuple(name for name in placed.names for _ in range(count)),
    )


STUDIES: dict[str, Callable[..., Cases]] = {
    "placement": placement_cases,
    "count": count_cases,
    "stiffness": stiffness_cases,
}
"""What each study compares, by its name."""
