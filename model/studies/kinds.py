"""The three studies and their cases."""

from collections.abc import Callable

import numpy as np

from model.errors import InputError
from model.rig.rig import Rig
from model.studies.cases import Cases, all_alike
from model.studies.pool import LayoutPool

STIFFNESS_FACTORS = 2.0 ** np.arange(-4, 5)
"""Factors of a stiffness study on the stiffness of the rig's ERAs."""

MAX_ERAS = 6
"""The largest number of ERAs of a count study of a rig that has no more."""


def placement_cases(rig: Rig, *, layouts: int, seed: int, raster: tuple[int, int]) -> Cases:
    """The rig's ERAs in other places: its own layout, those with a name, random ones."""
    if layouts < 1:
        raise InputError(f"number of layouts must be at least 1, got {layouts}")
    pool = LayoutPool(rig, raster)
    pool.add(len(rig.eras), layouts, np.random.default_rng(seed), own=True)
    return pool.cases()


def count_cases(rig: Rig, *, layouts: int, seed: int, raster: tuple[int, int]) -> Cases:
    """One to MAX_ERAS ERAs like the rig's, or as many as it has if those are more.

    With equal numbers of layouts for each count.
    """
    if not all_alike(rig.eras):
        raise InputError(
            "ERAs must be alike for a study of their count; give all of them the same stiffness, "
            "damping, bolt_mass, stroke and foot"
        )
    max_count = max(MAX_ERAS, len(rig.eras))
    if layouts < max_count:
        raise InputError(
            f"number of layouts must be at least {max_count} to compare 1 to {max_count} ERAs, "
            f"got {layouts}"
        )
    pool = LayoutPool(rig, raster)
    rng = np.random.default_rng(seed)
    for count in range(1, max_count + 1):
        share = layouts // max_count + (count <= layouts % max_count)
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
"""The cases of each study by its name."""
