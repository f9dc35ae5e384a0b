"""Which cases of a study support the plate, and what is wrong with the others."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.counting import counted
from model.design.support import ROUNDING, static_loads_of
from model.errors import InputError
from model.rig.rig import Rig
from model.structure.support import MIN_RIGID_BODY_FREQUENCY, rigid_body_frequencies_of
from model.studies.cases import Cases


@dataclass(frozen=True, eq=False)
class Support:
    """Support of n cases, as `model.design.support.SupportRule` demands it.

    lowest_hz (n,): least rigid-body frequency; is_tipping (n,): whether the plate tips over by its
    own weight; required_hz: the least frequency that is demanded.
    """

    lowest_hz: FloatArray
    is_tipping: NDArray[np.bool_]
    required_hz: float

    @property
    def is_supported(self) -> NDArray[np.bool_]:
        """Which cases support the plate, (n,)."""
        return np.asarray(~self.is_tipping & (self.lowest_hz >= self.required_hz))

    def problem(self, case: int) -> str | None:
        """What is wrong with a case, None for nothing."""
        if self.is_tipping[case]:
            return "tips over"
        if self.lowest_hz[case] < self.required_hz:
            return f"lowest mode {self.lowest_hz[case]:.3g} Hz"
        return None


def support_of(rig: Rig, cases: Cases, *, lowest: float) -> Support:
    """The support of cases of a rig; lowest [Hz]: least rigid-body frequency that is demanded."""
    mounts = cases.mounts(rig.eras)
    at = cases.positions[cases.places]  # of VACANT any, without stiffness and mass
    loads = [[load.x, load.y, load.stiffness, load.mass] for load in rig.masses]
    attached = np.concatenate([at, mounts[:, :, [0, 2]]], axis=2)
    carried = np.array(loads, dtype=float).reshape(-1, 4)
    carried = np.broadcast_to(carried, (len(cases), *carried.shape))
    attached = np.concatenate([attached, carried], axis=1)
    places, stiffness, mass = attached[..., :2], attached[..., 2], attached[..., 3]
    frequencies = rigid_body_frequencies_of(rig.plate, places, stiffness, mass)[:, 0]
    is_tipping = frequencies < MIN_RIGID_BODY_FREQUENCY
    held = np.flatnonzero(~is_tipping)
    weights = static_loads_of(rig.plate, places[held], stiffness[held], mass[held])
    count = (stiffness[held] > 0).sum(axis=1)
    is_tipping[held] = weights.min(axis=1) < -ROUNDING * weights.sum(axis=1) / count
    return Support(frequencies, is_tipping, lowest)


def check_supported_cases(support: Support) -> None:
    """Raise InputError if no case supports the plate, so that none could be recommended."""
    if support.is_supported.any():
        return
    count, tipping = len(support.lowest_hz), int(support.is_tipping.sum())
    raise InputError(
        f"a layout must support the plate, got {counted(count, 'layout')} of which none does: "
        f"{tipping} let it tip over and {count - tipping} have their lowest mode below "
        f"{support.required_hz:g} Hz; give the rig at least three ERAs, stiff enough, allow more "
        "--layouts or lower --lowest"
    )
