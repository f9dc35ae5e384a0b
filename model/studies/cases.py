"""Cases of a study: layouts of ERAs, each with a stiffness."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray, IntArray
from model.rig.layouts import alike, place_eras
from model.structure.actuator import Era

VACANT = -1
"""Padding after the last ERA of a layout."""

OWN = "own"
"""Name of the rig's own layout."""

Numbers: TypeAlias = NDArray[np.int32]


@dataclass(frozen=True)
class Cases:
    """Layouts chosen from positions, each with a factor on the stiffness of its ERAs.

    positions (c, 2) [m]; places (n, most eras) numbers of positions, VACANT after the last;
    stiffness_factors (n,); names: of the n layouts.
    """

    positions: FloatArray
    places: Numbers
    stiffness_factors: FloatArray
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.places)

    def take(self, numbers: IntArray | Sequence[int]) -> "Cases":
        """The cases of these numbers."""
        rows = np.asarray(numbers)
        names = tuple(self.names[row] for row in rows)
        return Cases(self.positions, self.places[rows], self.stiffness_factors[rows], names)

    def places_of(self, case: int) -> IntArray:
        """Numbers of the positions of one case's ERAs, (eras,)."""
        places = self.places[case]
        return np.asarray(places[places != VACANT], dtype=np.int64)

    def positions_of(self, case: int) -> FloatArray:
        """Positions [m] of the ERAs of one case, (eras, 2)."""
        return np.asarray(self.positions[self.places_of(case)])

    def eras_of(self, case: int, like: Sequence[Era]) -> tuple[Era, ...]:
        """The ERAs of one case, like those of a rig.

        Where the rig's are alike they are named E1, E2, ... anew, unless they stay where they are;
        where they differ each keeps its name. Stiffness times its factor, and damping so that the
        damping ratio, c / 2 sqrt(k_b m_plate / eras), stays.
        """
        positions = self.positions_of(case)
        stay = self.names[case] == OWN or not all_alike(tuple(like))
        eras = place_eras(like, positions) if stay else alike(like[0], positions)
        mounts = self.take([case]).mounts(like)[0].tolist()
        return tuple(
            replace(era, stiffness=stiffness, damping=damping)
            for era, (stiffness, damping, _) in zip(eras, mounts, strict=False)
        )

    def mounts(self, like: Sequence[Era]) -> FloatArray:
        """Stiffness, damping and bolt mass of all ERAs, (n, most eras, 3), zero where VACANT.

        As `eras_of` makes them.
        """
        count = self.places.shape[1]
        own = [like[0]] * count if all_alike(tuple(like)) else like
        mounts = np.array([[era.stiffness, era.damping, era.bolt_mass] for era in own])
        taken = self.places != VACANT
        factor = self.stiffness_factors
        damping = np.sqrt(factor * len(like) / taken.sum(axis=1))
        factors = np.stack([factor, damping, np.ones_like(factor)], axis=-1)
        return np.asarray(factors[:, None] * mounts * taken[:, :, None])


@cache
def all_alike(eras: tuple[Era, ...]) -> bool:
    """Whether ERAs differ in nothing but their names and places."""
    return len({replace(era, name="", x=0.0, y=0.0) for era in eras}) == 1
