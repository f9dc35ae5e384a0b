"""Parameters of a rig that a fit may change: their kinds, their space, and the values they stand
for.

A vector x has one number for each parameter, in standard deviations of what is known beforehand.
`Space` names them, `Values` converts x to springs, places, masses, losses and gains of the rig, and
`rig_with` writes these to a rig.

A plate may also have form errors, which a rig file does not describe: a cable glued to it, sides
that are not cut to size. Left out, they bias fitted values by far more than noise does, and no
residual shows by how much. They change stiffness and mass between the modes of the free plate, and
so its mode shapes (`ReducedModes`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import ComplexArray, FloatArray, IntArray
from model.fem import Mesh, element_slopes
from model.finger import Grid
from model.reduction.free_plate import TERMS, FreeModes, FreePlate
from model.reduction.reduced_plate import ReducedPlate, place_slopes, reduce_free_plate
from model.rig.rig import Rig, Uncertainty
from model.spectral.direct_solution import stiffness_slopes
from model.structure.attachments import (
    FEET_DEVIATE,
    Gain,
    PointLoad,
    damping_from_ratio,
    footprints_of,
)
from model.structure.exciter import Actuator, Exciter
from model.structure.modal_elasticity import Dispersion
from model.structure.plate import LOSS_FREQUENCY, MAX_LOSS_EXPONENT, MAX_LOSS_FACTOR, Plate

MASS_CELLS = Grid(8, 6)

MODE_SHIFTS = 12
"""Number of the lowest elastic modes with eigenvalues and loss factors of their own."""

FINGER_PARTS = ("contact mass", "pulp", "phalanx", "joint")
"""Parts of a finger's load that vary independently."""

_BUILT = Uncertainty()
_PHASE, _LENGTH, _WEIGHT = ("°", math.degrees(1)), ("mm", 1e3), ("g", 1e3)

UNIT_KEYS = {"%": "percent", "°": "deg", "/kHz²": "1/kHz^2", "/kHz": "1/kHz"}
"""Units in reports for programs, of those that people read in another way."""

EXCITER_KINDS = ("magnet_mass", "force_factor")
"""Kinds whose parameters only exciters have."""

FORM = ("sensor_scale", "sensor_place", "foreign_mass", "side", "poisson", "loss_law")
"""Kinds whose parameters only a plate with form errors has."""

COIL_DEVIATES = 0.2
"""Assumed standard deviation of the mass of an exciter's coil by its sheet, relative."""

MAX_GUESSED = math.sqrt(0.5)
"""Standard error of a parameter with a prior, in its deviations, beyond which the prior determines
it more than the data do."""

VALUE_UNITS = {
    "length": "m",
    "width": "m",
    "thickness": "m",
    "modulus": "Pa",
    "loss_factor": "",
    "stiffness": "N/m",
    "damping": "N s/m",
    "bolt_mass": "kg",
    "magnet_mass": "kg",
    "supports": "N/m",
}
"""Units of the values of a rig that parameters change."""

_AT_EDGE = 1e-6  # m

Number: TypeAlias = float | FloatArray
"""One number for all parameters of a kind, or one for each."""

_MIN_MASS = 1e-5  # kg; a lighter one is not written to a rig
_GAIN_STEP = 10.0  # Hz, of a drive that lags; linear between them is right to a thousandth


@dataclass(frozen=True)
class Kind:
    """Prior knowledge of all parameters of a kind, and how reports write them."""

    std: float
    """Standard deviation for a plate that was not measured, in the unit of `Values`."""
    unit: str = "%"
    """Unit in reports for people; logarithms of factors are written as per cent."""
    per_unit: float = 100.0
    """Number of report units in one unit of `Values`."""
    drift: float = 0.0
    """Standard deviation by which it walks in an hour of service."""
    drifts_to: float = 0.0
    """Largest standard deviation by drift, 0 for `std`."""
    theory: float = 0.0
    """Change of the fitted value by another theory of the plate."""
    sheet: float = 0.0
    """Standard deviation where data sheets alone describe a plate, 0 for `std`."""
    bound: float = math.inf
    """Largest deviation."""
    own_share: float = 0.0
    """Least `sheet` of what is added to a rig's value, as a share of that value."""

    @property
    def widest(self) -> float:
        """Largest standard deviation that drift leads to."""
        return self.drifts_to or self.std


KINDS = {
    "thickness": Kind(_BUILT.thickness, drift=0.01),
    "modulus": Kind(_BUILT.modulus, sheet=0.07, bound=math.log(3.0)),
    "stiffness": Kind(_BUILT.stiffness, drift=0.03, theory=3e-3, sheet=0.10, bound=math.log(10.0)),
    "damping": Kind(math.log(_BUILT.damping)),
    # Of one ERA beside that of all.
    "damping_each": Kind(0.2, drift=0.07, drifts_to=math.log(_BUILT.damping), theory=0.01),
    "loss": Kind(math.log(_BUILT.damping), drift=0.1),
    # Beside those of the rig, which may have none; data sheets give little, of ERAs by their ratio.
    "damping_added": Kind(0.0, "N s/m", 1.0, sheet=0.015, bound=2.0, own_share=0.7),
    "loss_added": Kind(0.0, "", 1.0, sheet=0.003, bound=0.5, own_share=0.7),
    # The power of frequency that the loss factor follows.
    "loss_exponent": Kind(0.3, "", 1.0),
    "gain": Kind(_BUILT.gain, drift=0.01, sheet=1.0, bound=8.0),
    "phase": Kind(math.radians(_BUILT.phase_deg), *_PHASE, drift=math.radians(1)),
    # A resonance at 700 Hz with a damping ratio of 0.5.
    "inertia": Kind(1 / 0.7**2, "/kHz²", 1.0),
    "drag": Kind(1 / 0.7, "/kHz", 1.0),
    # Of an amplifier's clock: what no exchange over unlike lines shows.
    "delay": Kind(200e-6, "us", 1e6),
    "sensor_gain": Kind(0.05),
    "sensor_phase": Kind(math.radians(5), *_PHASE),
    # By data sheets: of the plate's mass that an ERA carries.
    "bolt_mass": Kind(0.5e-3, *_WEIGHT, sheet=0.05, bound=5.0),
    # Of exciters.
    "magnet_mass": Kind(_BUILT.stiffness, bound=math.log(10.0)),
    "force_factor": Kind(_BUILT.stiffness, drift=0.01),
    # Of an ERA, on each axis.
    "place": Kind(1.5e-3, *_LENGTH, theory=1e-4),
    "masses": Kind(2e-3, *_WEIGHT),
    "mode_shifts": Kind(0.01, theory=3e-3, sheet=0.003),
    "mode_losses": Kind(0.5),
    # Of each foot.
    "supports": Kind(FEET_DEVIATE, bound=math.log(10.0)),
    # Of each group of a finger's load.
    "fingers": Kind(0.5),
    # Form errors: a ruler's, a cutter's, and 1 % of the plate's mass over all cells, as its shares.
    "sensor_scale": Kind(0.01),
    "sensor_place": Kind(0.5e-3, *_LENGTH),
    "foreign_mass": Kind(0.01 / math.sqrt(MASS_CELLS.cell_count)),
    "side": Kind(0.5e-3, *_LENGTH),
    "poisson": Kind(0.015, "", 1.0),
    # From hysteretic losses, 0, to viscous ones, 1 (`model.estimate.forward`).
    "loss_law": Kind(1.0, "", 1.0),
}
"""Kinds of parameters; for some a rig's `uncertainty` states the standard deviation instead.

`theory` is that of plates of 1.5 mm without shear deformation, with viscous losses
(docs/measured/identification.md). No measurement shows it, and answers do not depend on it.
"""


@dataclass(frozen=True, eq=False)
class Space:
    """Names of all p parameters with their standard deviations, bounds and kinds."""

    names: tuple[str, ...]
    std: FloatArray
    """Standard deviations (p,) in the units of `Values`, 0 where a parameter is known."""
    lower: FloatArray
    """Lower bounds of x (p,)."""
    upper: FloatArray
    """Upper bounds of x (p,)."""
    groups: dict[str, slice]
    """Slice of the parameters of each kind."""

    @property
    def size(self) -> int:
        """Number of parameters p."""
        return len(self.names)

    @cached_property
    def scale(self) -> FloatArray:
        """Standard deviations (p,), 1 of what is known."""
        return np.where(self.std > 0, self.std, 1.0)

    @cached_property
    def uncertain(self) -> NDArray[np.bool_]:
        """Mask (p,) of the parameters that are not known beforehand."""
        return np.asarray(self.std > 0)

    def of(self, *kinds: str) -> NDArray[np.bool_]:
        """Mask (p,) of the uncertain parameters of some kinds."""
        chosen = np.zeros(self.size, dtype=bool)
        for kind in kinds:
            chosen[self.groups[kind]] = True
        return chosen & self.uncertain

    def and_further(
        self,
        kind: str,
        names: Sequence[str],
        std: Number | None = None,
        lower: ArrayLike = -np.inf,
        upper: ArrayLike = np.inf,
    ) -> "Space":
        """Append parameters of a kind; std: by default the kind's."""
        own = KINDS[kind].std if std is None else std
        further = [np.broadcast_to(each, len(names)) for each in (own, lower, upper)]
        return Space(
            (*self.names, *names),
            np.append(self.std, further[0]),
            np.append(self.lower, further[1]),
            np.append(self.upper, further[2]),
            self.groups | {kind: slice(self.size, self.size + len(names))},
        )

    def of_kinds(self, known: Callable[[Kind], float]) -> FloatArray:
        """A property of the kind of each parameter, in its unit (p,), 0 for known ones."""
        found = np.zeros(self.size)
        for kind, part in self.groups.items():
            found[part] = known(KINDS[kind])
        return np.where(self.uncertain, found, 0.0)

    @cached_property
    def as_built(self) -> "Space":
        """The space of a plate that was not measured: `KINDS` where the rig states less."""
        return replace(self, std=np.maximum(self.std, self.of_kinds(lambda kind: kind.std)))

    def indices(self, kind: str) -> range:
        """Numbers of the parameters of a kind."""
        return range(*self.groups[kind].indices(self.size))

    def values(self, x: FloatArray, kind: str) -> FloatArray:
        """Deviations of the parameters of a kind from the rig, in their units, for x (p,)."""
        part = self.groups[kind]
        return np.asarray(self.std[part] * x[part])

    def index(self, name: str) -> int:
        """Number of the parameter of a name; raises ValueError for an unknown one."""
        return self.names.index(name)


def space_of(
    rig: Rig,
    sensors: Sequence[str],
    uncertainty: Uncertainty,
    *,
    drives_lag: bool = False,
    amplifiers: Sequence[str] = (),
    masses: int = 0,
    mode_count: int = MODE_SHIFTS,
    form_of: int | None = None,
) -> Space:
    """Parameters of a rig with sensors by name, with additional masses on it.

    uncertainty: of the rig; a modulus is known where the thickness is, the damping of each ERA and
    mode where that of all is. Its `common_gain` is no parameter: sensors may be those that it was
    found by, and tell nothing more of it. drives_lag: whether bases follow what is played with a
    lag that nothing states; amplifiers: those whose clocks may be off, by name; mode_count: elastic
    modes that may shift; form_of: number of sensors beside ERAs of a plate with form errors.
    """
    names = _names(rig, sensors, amplifiers, masses, mode_count, form_of)
    stds = _stds(rig, uncertainty, masses)
    # Only differences count: those to the first.
    stds["delay"] = np.where(np.arange(len(amplifiers)) > 0, KINDS["delay"].std, 0.0)
    # A measured gain has the lag of its drive in it, and an exciter's force that of its coil.
    lags = [drives_lag and not (era.gains or "force_factor" in era.fields) for era in rig.eras]
    for kind in ("inertia", "drag"):
        stds[kind] = np.where(lags, KINDS[kind].std, 0.0)
    bounds, space = _bounds(rig, masses), Space((), np.zeros(0), np.zeros(0), np.zeros(0), {})
    for kind, own in names.items():
        space = space.and_further(kind, own, stds.get(kind), *bounds.get(kind, (-np.inf, np.inf)))
    return space


def _names(
    rig: Rig,
    sensors: Sequence[str],
    amplifiers: Sequence[str],
    masses: int,
    mode_count: int,
    form_of: int | None,
) -> dict[str, Sequence[str]]:
    """Names of all parameters by their kind, as `space_of`."""
    eras, has_form = [era.name for era in rig.eras], form_of is not None
    drives = eras if any("force_factor" in era.fields for era in rig.eras) else []
    cells, modes = range(MASS_CELLS.cell_count), range(1, mode_count + 1)
    return {
        "thickness": ["thickness"],
        "modulus": ["modulus"],
        "stiffness": [f"stiffness {name}" for name in eras],
        "damping": ["damping"],
        "damping_each": [f"damping {name}" for name in eras],
        "damping_added": [f"further damping {name}" for name in eras],
        "loss": ["loss factor"],
        "loss_added": ["further loss factor"],
        "loss_exponent": ["loss exponent"],
        "gain": [f"gain {name}" for name in eras],
        "phase": [f"phase {name}" for name in eras],
        "inertia": [f"inertia of drive {name}" for name in eras],
        "drag": [f"drag of drive {name}" for name in eras],
        "delay": [f"delay of amplifier {name}" for name in amplifiers],
        "sensor_gain": [f"gain of sensor {name}" for name in sensors],
        "sensor_phase": [f"phase of sensor {name}" for name in sensors],
        "bolt_mass": [f"bolt mass {name}" for name in eras],
        "magnet_mass": [f"magnet mass {name}" for name in drives],
        "force_factor": [f"force factor {name}" for name in drives],
        "place": [f"{axis} of {name}" for name in eras for axis in "xy"],
        "masses": [f"{of}mass {n}" for n in range(1, masses + 1) for of in ("", "x of ", "y of ")],
        "mode_shifts": [f"stiffness of mode {number}" for number in modes],
        "mode_losses": [f"loss of mode {number}" for number in modes],
        "supports": [f"stiffness of foot {name}" for name in rig.foot_names],
        "fingers": [],
        "sensor_scale": [f"scale of sensor {name}" for name in sensors if has_form],
        "sensor_place": [f"{axis} of sensor {n}" for n in range(form_of or 0) for axis in "xy"],
        "foreign_mass": [f"mass {n}" for n in cells if has_form],
        "side": ["length", "width"] if has_form else [],
        "poisson": ["Poisson's ratio"] if has_form else [],
        "loss_law": ["loss law"] if has_form else [],
    }


def _stds(rig: Rig, uncertainty: Uncertainty, masses: int) -> dict[str, Number]:
    """Standard deviations of parameters, where they are not those of their kind, as `space_of`."""
    plate, sides = rig.plate, np.array([rig.plate.length, rig.plate.width])
    excites = np.array(["force_factor" in era.fields for era in rig.eras])
    of_drives = uncertainty.stiffness * (excites if excites.any() else excites[:0])
    damping = math.log(uncertainty.damping)
    damped = (damping > 0) * np.array([float(era.damping > 0) for era in rig.eras])
    lossy = float(damping > 0 and plate.loss_factor > 0)
    return {
        "thickness": uncertainty.thickness,
        "modulus": max(KINDS["modulus"].std, uncertainty.modulus) * (uncertainty.thickness > 0),
        "stiffness": uncertainty.stiffness,
        "damping": damping * damped.max(),
        "damping_each": KINDS["damping_each"].std * damped,
        "loss": damping * lossy,
        "loss_exponent": KINDS["loss_exponent"].std * lossy,
        "gain": uncertainty.gain,
        "phase": math.radians(uncertainty.phase_deg),
        "magnet_mass": of_drives,
        "force_factor": of_drives,
        # About the middle of the plate.
        "masses": np.tile([KINDS["masses"].std, *sides / 3], masses),
        "mode_losses": KINDS["mode_losses"].std * lossy,
        "supports": uncertainty.supports,
    }


def _bounds(rig: Rig, masses: int) -> dict[str, tuple[ArrayLike, ArrayLike]]:
    """Bounds of x of the kinds of parameters that have some, as `space_of`."""
    sides = np.array([rig.plate.length, rig.plate.width])
    places = np.array([(era.x, era.y) for era in rig.eras])
    least = np.array([-getattr(era, era.fields["bolt_mass"]) for era in rig.eras])
    exponents = np.array([-MAX_LOSS_EXPONENT, MAX_LOSS_EXPONENT]) - rig.plate.loss_exponent
    return {
        "loss_exponent": tuple(exponents / KINDS["loss_exponent"].std),
        "inertia": (0.0, np.inf),
        "drag": (0.0, np.inf),
        "bolt_mass": (least / KINDS["bolt_mass"].std, np.inf),
        "place": (
            (-places / KINDS["place"].std).ravel(),
            ((sides - places) / KINDS["place"].std).ravel(),
        ),
        "masses": (np.tile([0.0, -1.5, -1.5], masses), np.tile([np.inf, 1.5, 1.5], masses)),
    }


def space_by_sheets(rig: Rig, sensors: Sequence[str], form_modes: int | None) -> Space:
    """Parameters of a rig of data sheets: its plate's modulus and losses, its ERAs and their gains.

    A force factor damps as the suspension of its exciter does, and no response tells them apart.

    form_modes: also form errors, with so many modes that shift; None for none. All else is known.
    """
    plate, count, has_form = rig.plate, len(rig.eras), form_modes is not None
    space = space_of(
        rig,
        sensors,
        Uncertainty.none(),
        mode_count=form_modes or 0,
        form_of=len(sensors) if has_form else None,
    )
    damping, bolt = (
        np.array([getattr(era, era.fields[kind]) for era in rig.eras])
        for kind in ("damping", "bolt_mass")
    )
    ratio = np.array(
        [
            damping_from_ratio(
                1.0, stiffness=era.in_time.stiffness, plate_mass=plate.mass, era_count=count
            )
            for era in rig.eras
        ]
    )
    # The rig's value, which cannot become less than zero, and what deviations are relative to.
    added: dict[str, tuple[Number, Number]] = {
        "loss_added": (plate.loss_factor, 1.0),
        "damping_added": (damping, ratio),
        "bolt_mass": (bolt, plate.mass / count),
    }
    # Places may leave the plate, whose shapes go on by their slopes.
    form = (*FORM, "place", "mode_shifts") if has_form else ()
    excites = np.array(["force_factor" in era.fields for era in rig.eras])
    of_exciters = EXCITER_KINDS if excites.any() else ()
    columns = np.repeat([[0.0], [-np.inf], [np.inf]], space.size, axis=1)
    for name in ("modulus", "stiffness", "gain", *of_exciters, *added, *form):
        kind, (value, unit) = KINDS[name], added.get(name, (0.0, 1.0))
        own = np.maximum(kind.own_share * value, (kind.sheet or kind.std) * unit)
        std = np.maximum(own, rig.uncertainty.stiffness * (name in ("stiffness", *of_exciters)))
        lower = -value if name in added else -kind.bound
        upper = np.maximum(kind.bound * unit - value, value)
        columns[:, space.groups[name]] = np.array(
            np.broadcast_arrays(std, lower / std, upper / std)
        ).reshape(3, -1)
    for name in of_exciters:
        columns[0, space.groups[name]] *= excites
    # A coil weighs what its sheet says, but for glue; a response tells it together with a gain.
    weighs = excites & (bolt > 0)
    coils = np.flatnonzero(weighs) + space.groups["bolt_mass"].start
    columns[:, coils] = _known(COIL_DEVIATES * bolt[weighs], -bolt[weighs], bolt[weighs])
    feet, bound = space.groups["supports"], KINDS["supports"].bound
    stated = rig.uncertainty.supports
    columns[:, feet] = _known(np.full(len(rig.feet), stated), -bound, bound) if stated else 0.0
    return replace(space, std=columns[0], lower=columns[1], upper=columns[2])


def _known(std: FloatArray, lower: Number, upper: Number) -> FloatArray:
    """Standard deviations (m,) and the bounds in them, (3, m)."""
    return np.array([std, lower / std, upper / std])


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


@dataclass(frozen=True, eq=False)
class Values:
    """Values of a rig's plate with n ERAs, m additional masses, k fingers and s sensors.

    Arrays of form errors are empty for a plate without them.
    """

    thickness: float
    """Factor on the rig's."""
    modulus: float
    """Factor on the rig's."""
    loss_factor: float
    """At LOSS_FREQUENCY."""
    loss_exponent: float
    """Power of frequency that the loss factor follows."""
    stiffness: FloatArray
    """Of the ERAs (n,) [N/m]."""
    damping: FloatArray
    """Of the ERAs (n,) [N s/m]."""
    bolt_mass: FloatArray
    """Of the ERAs, of exciters the coil (n,) [kg]."""
    magnet_mass: FloatArray
    """Factors of exciters (n,)."""
    force_factor: FloatArray
    """Factors of exciters (n,)."""
    supports: FloatArray
    """Factors on the stiffness of each foot (q,)."""
    places: FloatArray
    """Of the ERAs (n, 2) [m]."""
    masses: FloatArray
    """Additional masses [kg] with x and y [m] (m, 3)."""
    mode_shifts: FloatArray
    """Logarithms of factors on the eigenvalues of the lowest modes."""
    mode_losses: FloatArray
    """Logarithms of factors on the loss factors of the lowest modes."""
    drive_gains: ComplexArray
    """Complex gains (n,) beside those of the rig."""
    sensor_gains: ComplexArray
    """Complex gains (s,)."""
    fingers: FloatArray
    """Logarithms of factors on FINGER_PARTS (k, 4)."""
    inertia: FloatArray
    """By which drives lag (n,) [1/kHz²]."""
    drag: FloatArray
    """By which drives lag (n,) [1/kHz]."""
    delays: FloatArray
    """Of the amplifiers' clocks behind the first one's [s], by name; empty where they agree."""
    sensor_scales: FloatArray
    """Real gains of sensors, a form error (s,)."""
    sensor_places: FloatArray
    """Distances of sensors from their places (s, 2) [m]."""
    foreign_mass: FloatArray
    """Of each cell, as a share of the plate's; the sum is zero (c,)."""
    stretch: FloatArray
    """Deviations of length and width, relative, and of Poisson's ratio (3,)."""
    loss_law: float
    """0 for hysteretic losses, 1 for viscous ones."""

    @classmethod
    def of(cls, rig: Rig, space: Space, x: FloatArray) -> Self:
        """Those of parameters x (p,)."""

        def own(kind: str) -> FloatArray:
            return space.values(x, kind)

        plate, n = rig.plate, len(rig.eras)
        k, c, m = (
            np.array([getattr(era, era.fields[kind]) for era in rig.eras])
            for kind in ("stiffness", "damping", "bolt_mass")
        )
        at = np.array([(era.x, era.y) for era in rig.eras])
        sides = np.array([plate.length, plate.width])
        masses = own("masses").reshape(-1, 3)
        masses[:, 1:] = np.clip(masses[:, 1:] + sides / 2, 0, sides)
        cells = own("foreign_mass")
        loss = plate.loss_factor * np.exp(own("loss")[0]) + own("loss_added")[0]
        return cls(
            thickness=float(np.exp(own("thickness")[0])),
            modulus=float(np.exp(own("modulus")[0])),
            loss_factor=float(np.clip(loss, 0.0, MAX_LOSS_FACTOR)),
            loss_exponent=float(plate.loss_exponent + own("loss_exponent")[0]),
            stiffness=k * np.exp(own("stiffness")),
            damping=c * np.exp(own("damping") + own("damping_each")) + own("damping_added"),
            bolt_mass=m + own("bolt_mass"),
            magnet_mass=np.exp(np.append(own("magnet_mass"), np.zeros(n))[:n]),
            force_factor=np.exp(np.append(own("force_factor"), np.zeros(n))[:n]),
            supports=np.exp(own("supports")),
            places=at + own("place").reshape(n, 2),
            masses=masses,
            mode_shifts=own("mode_shifts"),
            mode_losses=own("mode_losses"),
            drive_gains=np.exp(own("gain") + 1j * own("phase")),
            sensor_gains=np.exp(own("sensor_gain") + 1j * own("sensor_phase")),
            fingers=own("fingers").reshape(-1, 4),
            inertia=own("inertia"),
            drag=own("drag"),
            delays=own("delay"),
            sensor_scales=1 + own("sensor_scale"),
            sensor_places=own("sensor_place").reshape(-1, 2),
            foreign_mass=cells - (cells.mean() if len(cells) else 0.0),
            stretch=np.append(own("side") / sides[: len(own("side"))], own("poisson")),
            loss_law=float(own("loss_law").sum()),
        )

    def sources(self, rig: Rig) -> tuple[Actuator, ...]:
        """The rig's ERAs with their values, where the rig has them and without gains."""
        found: list[Actuator] = []
        for number, era in enumerate(rig.eras):
            new = {
                "stiffness": self.stiffness[number],
                "damping": max(self.damping[number], 0.0),
                "bolt_mass": max(self.bolt_mass[number], 0.0),
            }
            for kind in era.fields.keys() - new:
                new[kind] = getattr(self, kind)[number] * getattr(era, era.fields[kind])
            fields: dict[str, Any] = {era.fields[kind]: float(value) for kind, value in new.items()}
            if isinstance(era, Exciter):
                largest = era.largest_force_factor(fields["magnet_mass"])
                fields["force_factor"] = min(fields["force_factor"], largest)
            found.append(replace(era, gains=(), **fields))
        return tuple(found)

    def lag(self, frequencies: FloatArray) -> ComplexArray:
        """Motion of each drive at frequencies (f,) [Hz] relative to a slow one, (f, n).

        1 / (1 - inertia f² + i drag f), f in kilohertz: of an actuator with a resonance at
        1 / sqrt(inertia) and a damping ratio of drag / (2 sqrt(inertia)).
        """
        f = 1e-3 * np.asarray(frequencies)[:, None]
        return np.asarray(1 / (1 - self.inertia * f**2 + 1j * self.drag * f))


def rig_with(rig: Rig, values: Values, uncertainty: Uncertainty) -> Rig:
    """The rig with identified values; additional masses come after its own."""
    places = np.clip(values.places, 0, [rig.plate.length, rig.plate.width])
    eras = tuple(
        replace(
            era,
            x=float(places[number, 0]),
            y=float(places[number, 1]),
            gains=_gains(rig, values, number),
        )
        for number, era in enumerate(values.sources(rig))
    )
    masses = list(rig.masses)
    for foot, factor in zip(rig.feet, values.supports.tolist(), strict=True):
        masses[foot] = replace(masses[foot], stiffness=factor * masses[foot].stiffness)
    return replace(
        rig,
        plate=plate_with(rig.plate, values),
        laminate=rig.laminate
        and rig.laminate.scaled(modulus=values.modulus, thickness=values.thickness),
        eras=eras,
        masses=(*masses, *additional_masses(values)),
        uncertainty=uncertainty,
    )


def plate_with(plate: Plate, values: Values) -> Plate:
    """The plate with identified thickness, modulus, losses and modes."""
    count = max(len(plate.mode_deviations), len(values.mode_shifts))
    deviations = np.zeros((count, 2))
    deviations[: len(plate.mode_deviations)] = np.reshape(plate.mode_deviations, (-1, 2))
    deviations[: len(values.mode_shifts)] += np.column_stack(
        [values.mode_shifts, values.mode_losses]
    )
    return replace(
        plate.scaled(modulus=values.modulus, thickness=values.thickness),
        loss_factor=values.loss_factor,
        loss_exponent=values.loss_exponent,
        mode_deviations=tuple((float(a), float(b)) for a, b in deviations if deviations.any()),
    )


def additional_masses(values: Values) -> Sequence[PointLoad]:
    """The additional masses on the plate, without those that weigh nothing."""
    return [
        PointLoad(float(x), float(y), mass=float(mass))
        for mass, x, y in values.masses
        if mass > _MIN_MASS
    ]


def _gains(rig: Rig, values: Values, number: int) -> tuple[Gain, ...]:
    """Gains of an ERA: those of the rig times what was identified.

    An ERA without measured gains gets one at a single frequency, or some over the rig's frequencies
    where its drive or the clock of its amplifier lags.
    """
    era = rig.eras[number]
    lags, delay = values.inertia[number] or values.drag[number], _delay(era.name, rig, values)
    if values.drive_gains[number] == 1 and not (lags or delay):
        return era.gains
    before = era.gains or ((LOSS_FREQUENCY, 1.0, 0.0),)
    if lags or (delay and not era.gains):
        low, high = rig.limits.frequency_min, rig.limits.frequency_max
        count = 1 + int(np.ceil((high - low) / _GAIN_STEP))
        before = tuple((float(f), 1.0, 0.0) for f in np.linspace(low, high, count))
    f = np.array([f for f, *_ in before])
    late = np.exp(-2j * np.pi * f * delay)
    factors = values.drive_gains[number] * values.lag(f)[:, number] * late
    return tuple(
        (f, magnitude * float(abs(factor)), turned + float(np.angle(factor)))
        for (f, magnitude, turned), factor in zip(before, factors.tolist(), strict=True)
    )


def _delay(era: str, rig: Rig, values: Values) -> float:
    """Delay of an ERA by its amplifier's clock [s]."""
    if not len(values.delays):
        return 0.0
    names = sorted({channel.amplifier for channel in rig.wiring.values()})
    return float(values.delays[names.index(rig.wiring[era].amplifier)])


@dataclass(frozen=True, eq=False)
class ReducedModes:
    """A plate's modes and residual vectors at all that is attached, for one with form errors.

    No further modes count as truncated.
    """

    plate: ReducedPlate
    cells: FloatArray
    """Shapes where foreign mass may lie (c, r)."""
    stiffening: FloatArray
    """Derivatives (3, r, r) [rad²/s²] of the stiffness between coordinates by length, width
    (relative) and Poisson's ratio."""

    @property
    def eigenvalues(self) -> FloatArray:
        """omega² (r,) [rad²/s²]."""
        return np.asarray(self.plate.omega**2)

    @property
    def losses(self) -> FloatArray:
        """Their imaginary part beside the plate's own loss factor (r,)."""
        return self.plate.losses

    @property
    def dispersion(self) -> Dispersion | None:
        """How they change with frequency, None where they do not."""
        return self.plate.dispersion

    def shapes_at(self, points: FloatArray) -> FloatArray:
        """Shapes at points or footprints [m], (n, r)."""
        return self.plate.at(points)

    def truncated_terms(self, points: FloatArray, others: FloatArray) -> FloatArray:
        """Sums over truncated modes: zero, (TERMS, n, m)."""
        return np.zeros((TERMS, len(points), len(others)))


def reduced_modes(rig: Rig, free: FreePlate) -> ReducedModes:
    """Reduce a rig's free plate to coordinates in which it may have form errors."""
    plate = rig.plate
    reduced = reduce_free_plate(free, footprints_of(rig.eras, rig.masses))
    cells = MASS_CELLS.centres(plate)
    unknowns = reduced.unknowns()
    if isinstance(free.mesh, Mesh):
        stiffening = element_slopes(plate, free.mesh, unknowns[0])
    else:
        degrees = free.mesh.nx, free.mesh.ny
        frequency = math.sqrt(plate.lowest_bending_frequency * free.frequency_max)
        stiffening = stiffness_slopes(plate, degrees, unknowns, frequency=frequency)
    return ReducedModes(reduced, reduced.at(cells), stiffening)


Modes: TypeAlias = FreeModes | ReducedModes


@dataclass(frozen=True, eq=False)
class AttachmentPoints:
    """Shapes at a points of attachment and observation, v of which may move along x and y."""

    footprints: FloatArray
    """Place and radius of each (a, 3) [m]."""
    shapes: FloatArray
    """Mode shapes (a, r)."""
    truncated: FloatArray
    """Sums over truncated modes (TERMS, a, a)."""
    shape_slopes: FloatArray
    """Derivatives of the shapes by x and y of each movable point in turn (2 v, r) [1/m]."""
    truncated_slopes: FloatArray
    """Derivatives of the sums by the place of the first point (TERMS, 2 v, a) [1/m]."""

    def moved(self, footprints: FloatArray, movable: IntArray) -> "AttachmentPoints":
        """The same for other footprints (a, 3), by the slopes of the shapes alone."""
        off = (footprints - self.footprints)[movable, :2].reshape(-1, 2, 1)
        slopes = self.shape_slopes.reshape(len(movable), 2, self.shapes.shape[1])
        shapes = self.shapes.copy()
        shapes[movable] += (off * slopes).sum(axis=1)
        return replace(self, footprints=footprints, shapes=shapes)


def places_of(
    modes: Modes, footprints: FloatArray, movable: IntArray, sides: FloatArray
) -> AttachmentPoints:
    """Solve for footprints (a, 3) on a plate of some sides (2,) [m].

    movable (v,): numbers of those that may move.
    """
    moving, shapes = footprints[movable], modes.shapes_at(footprints)
    truncated = modes.truncated_terms(footprints, footprints)
    if not len(movable):
        none = np.zeros((len(truncated), 0, len(footprints)))
        return AttachmentPoints(footprints, shapes, truncated, np.zeros((0, shapes.shape[1])), none)

    def field(points: FloatArray) -> FloatArray:
        return modes.truncated_terms(points, footprints).swapaxes(0, 1)

    by_place = place_slopes(field, moving, sides)
    return AttachmentPoints(
        footprints,
        shapes,
        truncated,
        place_slopes(modes.shapes_at, moving, sides).reshape(-1, shapes.shape[1]),
        np.moveaxis(by_place, 2, 0).reshape(len(truncated), -1, len(footprints)),
    )
