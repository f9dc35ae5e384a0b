"""The vector of parameters x, in prior standard deviations, and the values that it stands for."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model.arrays import FloatArray
from model.identification.priors import Priors
from model.rig.rig import Rig
from model.structure.plate import MAX_LOSS_EXPONENT

MODE_SHIFTS = 12
"""Of so many of the lowest elastic modes eigenvalue and loss factor may differ from the model's."""

FINGER_PARTS = ("contact mass", "pulp", "phalanx", "joint")
"""Groups of a finger's load that vary on their own."""

_AT_EDGE = 1e-6  # m


@dataclass(frozen=True, eq=False)
class Space:
    """Names of all p parameters, and standard deviations, bounds of x and groups of them.

    std (p,), in the units of `Values`, 0 where a parameter is known; lower, upper (p,): of x;
    groups: by kind, where its parameters are.
    """

    names: tuple[str, ...]
    std: FloatArray
    lower: FloatArray
    upper: FloatArray
    groups: dict[str, slice]

    @property
    def size(self) -> int:
        """Number of parameters p."""
        return len(self.names)

    @cached_property
    def uncertain(self) -> NDArray[np.bool_]:
        """Which are not known beforehand, (p,)."""
        return np.asarray(self.std > 0)

    def of(self, *kinds: str) -> NDArray[np.bool_]:
        """Which are of these kinds and uncertain, (p,)."""
        chosen = np.zeros(self.size, dtype=bool)
        for kind in kinds:
            chosen[self.groups[kind]] = True
        return chosen & self.uncertain

    def indices(self, kind: str) -> range:
        """Numbers of the parameters of a kind."""
        return range(*self.groups[kind].indices(self.size))

    def values(self, x: FloatArray, kind: str) -> FloatArray:
        """What x (p,) makes of the parameters of a kind, from their values in the rig."""
        part = self.groups[kind]
        return np.asarray(self.std[part] * x[part])

    def index(self, name: str) -> int:
        """Where the parameter of a name is; raises ValueError for an unknown one."""
        return self.names.index(name)


def space_of(
    rig: Rig,
    sensors: Sequence[str],
    priors: Priors,
    *,
    masses: int = 0,
    fingers: int = 0,
    mode_count: int = MODE_SHIFTS,
) -> Space:
    """Parameters of a rig with sensors by name, with additional masses and fingers on it.

    mode_count: elastic modes of the model, of which the lowest may shift.
    """
    plate, eras = rig.plate, [era.name for era in rig.eras]
    builder = _Builder()
    add = builder.add
    add("thickness", ["thickness"], priors.thickness)
    add("modulus", ["modulus"], priors.modulus)
    add("stiffness", [f"stiffness {name}" for name in eras], priors.stiffness)
    damped = priors.damping if any(era.damping for era in rig.eras) else 0.0
    add("damping", ["damping"], damped)
    each = [priors.damping_each if era.damping else 0.0 for era in rig.eras]
    add("damping_each", [f"damping {name}" for name in eras], each)
    lossy = plate.loss_factor > 0
    add("loss", ["loss factor"], priors.loss * lossy)
    exponents = np.array([-MAX_LOSS_EXPONENT, MAX_LOSS_EXPONENT]) - plate.loss_exponent
    low, high = exponents / (priors.loss_exponent or 1.0)
    add("loss_exponent", ["loss exponent"], priors.loss_exponent * lossy, lower=low, upper=high)
    add("gain", [f"gain {name}" for name in eras], priors.gain)
    add("phase", [f"phase {name}" for name in eras], priors.phase)
    for kind in ("inertia", "drag"):
        # A measured gain has them in it.
        lagging = [0.0 if era.gains else getattr(priors, kind) for era in rig.eras]
        add(kind, [f"{kind} of drive {name}" for name in eras], lagging, lower=0.0)
    add("sensor_gain", [f"gain of sensor {name}" for name in sensors], priors.sensor_gain)
    add("sensor_phase", [f"phase of sensor {name}" for name in sensors], priors.sensor_phase)
    least = [-era.bolt_mass / (priors.bolt_mass or 1.0) for era in rig.eras]
    add("bolt_mass", [f"bolt mass {name}" for name in eras], priors.bolt_mass, lower=least)
    sides = np.array([plate.length, plate.width])
    places = np.array([(era.x, era.y) for era in rig.eras])
    in_stds = priors.place or 1.0
    add(
        "place",
        [f"{axis} of {name}" for name in eras for axis in "xy"],
        priors.place,
        lower=(-places / in_stds).ravel(),
        upper=((sides - places) / in_stds).ravel(),
    )
    # About the middle of the plate.
    reach = priors.mass_place * sides
    each_mass = np.array([priors.mass, *reach])
    bounds = sides / 2 / (reach if priors.mass_place else 1.0)
    add(
        "masses",
        [f"{of}mass {n}" for n in range(1, masses + 1) for of in ("", "x of ", "y of ")],
        np.tile(each_mass, masses),
        lower=np.tile([0.0, *-bounds], masses),
        upper=np.tile([np.inf, *bounds], masses),
    )
    modes = range(1, min(mode_count, MODE_SHIFTS) + 1)
    add("mode_shifts", [f"stiffness of mode {number}" for number in modes], priors.mode_shift)
    add("mode_losses", [f"loss of mode {number}" for number in modes], priors.mode_loss * lossy)
    add(
        "fingers",
        [f"{part} of finger {n}" for n in range(1, fingers + 1) for part in FINGER_PARTS],
        priors.finger,
    )
    return builder.space()


def inwards(space: Space, x: FloatArray, *, by: float) -> FloatArray:
    """Move the places of x (p,) that are on an edge inwards, by so many standard deviations.

    There a place cannot go the other way, and half of a start's surroundings would be lost.
    """
    moved = x.copy()
    for number in space.indices("place"):
        if space.std[number] * (x[number] - space.lower[number]) < _AT_EDGE:
            moved[number] += by
        elif space.std[number] * (space.upper[number] - x[number]) < _AT_EDGE:
            moved[number] -= by
    return np.where(space.uncertain, moved, x)


class _Builder:
    """Collects the groups of a space in their order."""

    def __init__(self) -> None:
        self._names: list[str] = []
        self._columns: list[FloatArray] = []
        self._groups: dict[str, slice] = {}

    def add(
        self,
        kind: str,
        names: Sequence[str],
        std: float | Sequence[float] | FloatArray,
        *,
        lower: Sequence[float] | FloatArray | float = -np.inf,
        upper: Sequence[float] | FloatArray | float = np.inf,
    ) -> None:
        start, count = len(self._names), len(names)
        self._names += names
        self._groups[kind] = slice(start, start + count)
        columns = [np.broadcast_to(np.asarray(each, float), count) for each in (std, lower, upper)]
        self._columns.append(np.array(columns).reshape(3, count))

    def space(self) -> Space:
        std, lower, upper = np.concatenate(self._columns, axis=1)
        return Space(tuple(self._names), std, lower, upper, self._groups)
