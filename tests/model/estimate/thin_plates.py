"""Hidden plates that another theory solves: thin plates on ERAs, with and without faults.

They are solved in Bogner-Fox-Schmit elements, which is another theory and element than the model's:
Kirchhoff's plate without shear and rotary inertia, products of cubic Hermite polynomials on a
regular grid, all of its modes; ERAs, masses and fingers attached by their equations of motion. The
loss is that of viscous modes, eta w w_r in place of eta w_r². Nothing of the model is used.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from model.estimate.identify import Identification
from model.estimate.measurement import Measurement, sensors_at
from model.estimate.parameters import PARAMETER_KINDS
from model.estimate.relevant_quantities import relevant

Reals: TypeAlias = NDArray[np.float64]
Complexes: TypeAlias = NDArray[np.complex128]

ELEMENTS = (13, 10)
LOSS_AT = 150.0  # Hz


@dataclass(frozen=True, eq=False)
class Line:
    """Cubic Hermite elements on (0, length) [m]: deflection and slope at each node."""

    length: float
    elements: int

    @property
    def step(self) -> float:
        """Length of an element [m]."""
        return self.length / self.elements

    def integrals(
        self, start: float = 0.0, end: float = np.inf, *, slope: float = 0.0, power: int = 1
    ) -> dict[tuple[int, int], Reals]:
        """Integrals of derivative a of one function and b of another, by (a, b).

        start, end [m]: of the part over which they are taken; slope, power: of a factor
        (1 + slope u)^power, u from -1 to 1 along the line.
        """
        points, weights = np.polynomial.legendre.leggauss(6)
        size = 2 * (self.elements + 1)
        found = {key: np.zeros((size, size)) for key in ((0, 0), (1, 1), (2, 2), (2, 0))}
        for e in range(self.elements):
            low, high = np.clip((np.array([start, end]) / self.step) - e, 0, 1)
            t, own = low + (high - low) * (points + 1) / 2, weights / 2 * (high - low) * self.step
            own = own * (1 + slope * (2 * (e + t) / self.elements - 1)) ** power
            for (a, b), total in found.items():
                local = np.einsum("q,qi,qj->ij", own, self._local(t, a), self._local(t, b))
                total[2 * e : 2 * e + 4, 2 * e : 2 * e + 4] += local
        return found

    def at(self, x: Reals) -> Reals:
        """Values of all functions at x (p,), beyond an end at it, (p, 2 nodes)."""
        x = np.clip(x, 0.0, self.length)
        element = np.clip((x / self.step).astype(int), 0, self.elements - 1)
        values = self._local(x / self.step - element, 0)
        found = np.zeros((len(x), 2 * (self.elements + 1)))
        rows = np.arange(len(x))[:, None]
        found[rows, 2 * element[:, None] + np.arange(4)] = values
        return found

    def _local(self, t: Reals, derivative: int) -> Reals:
        """The four functions of an element at t in (0, 1), or a derivative, (q, 4)."""
        h = self.step
        cubics = np.array([[1, 0, -3, 2], [0, h, -2 * h, h], [0, 0, 3, -2], [0, 0, -h, h]])
        rows = [np.polynomial.polynomial.polyder(c, derivative) for c in cubics]
        values = [np.polynomial.polynomial.polyval(t, row) for row in rows]
        return np.asarray(np.array(values).T / h**derivative, dtype=float)


@dataclass(frozen=True, eq=False)
class ThinPlate:
    """A free plate: sides, thickness [m], E [Pa], rho [kg/m³], nu.

    parts: x from, to, y from, to [m] of parts that are stiffer and heavier, and what they have of
    rigidity and of mass beside the plate's, relative; taper: thickness that each side's ends have
    more or less than its middle, relative.
    """

    length: float
    width: float
    thickness: float
    modulus: float
    density: float
    ratio: float
    parts: tuple[tuple[float, ...], ...] = ()
    taper: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def _lines(self) -> tuple[Line, Line]:
        return Line(self.length, ELEMENTS[0]), Line(self.width, ELEMENTS[1])

    @cached_property
    def modes(self) -> tuple[Reals, Reals]:
        """Eigenvalues omega² (r,) [rad²/s²] and modes (size, r) of modal mass 1."""
        along, across = self._lines
        lines = list(zip(self._lines, self.taper, strict=True))
        x, y = (line.integrals(slope=slope, power=3) for line, slope in lines)
        mass_x, mass_y = (line.integrals(slope=slope)[0, 0] for line, slope in lines)
        rigidity = self.modulus * self.thickness**3 / 12 / (1 - self.ratio**2)
        stiffness, mass = self._bending(x, y), np.kron(mass_x, mass_y)
        for *place, stiffer, heavier in self.parts:
            of_x, of_y = along.integrals(*place[:2]), across.integrals(*place[2:])
            stiffness = stiffness + stiffer * self._bending(of_x, of_y)
            mass = mass + heavier * np.kron(of_x[0, 0], of_y[0, 0])
        mass = self.density * self.thickness * mass
        values, vectors = linalg.eigh(rigidity * stiffness, mass)
        values[:3] = 0.0
        return values, vectors

    def _bending(self, x: dict[tuple[int, int], Reals], y: dict[tuple[int, int], Reals]) -> Reals:
        """Stiffness at a rigidity of 1, by integrals along both sides."""
        nu, mixed = self.ratio, np.kron(x[2, 0], y[2, 0].T)
        stiffness = np.kron(x[2, 2], y[0, 0]) + np.kron(x[0, 0], y[2, 2])
        twist = 2 * (1 - nu) * np.kron(x[1, 1], y[1, 1])
        return np.asarray(stiffness + nu * (mixed + mixed.T) + twist)

    def thinned(self, factor: float) -> "ThinPlate":
        """The plate with its thickness times a factor, whose modes scale exactly."""
        values, vectors = self.modes
        thinner = replace(self, thickness=factor * self.thickness)
        thinner.__dict__["modes"] = (factor**2 * values, vectors / np.sqrt(factor))
        return thinner

    def shapes(self, points: Reals) -> Reals:
        """Mode shapes at points (p, 2) [m], (p, r)."""
        along = [line.at(points[:, axis]) for axis, line in enumerate(self._lines)]
        functions = along[0][:, :, None] * along[1][:, None, :]
        return np.asarray(functions.reshape(len(points), -1) @ self.modes[1])


@dataclass(frozen=True, eq=False)
class Mounted:
    """A plate on n ERAs with masses.

    at (n, 2) [m]; stiffness, damping, bolt, gain (n,); masses (m, 3): x, y [m] and mass [kg];
    loss: factor at LOSS_AT, loss_exponent of its power of frequency.
    """

    plate: ThinPlate
    at: Reals
    stiffness: Reals
    damping: Reals
    bolt: Reals
    gain: Complexes
    masses: Reals
    loss: float
    loss_exponent: float

    @cached_property
    def attached(self) -> Reals:
        """Mode shapes at ERAs and masses (n + m, r)."""
        return self.plate.shapes(np.vstack([self.at, self.masses[:, :2]]))

    def receptance(self, frequency: float) -> Complexes:
        """Of each mode of the free plate, (r,)."""
        w, values = 2 * np.pi * frequency, self.plate.modes[0]
        loss = self.loss * (frequency / LOSS_AT) ** self.loss_exponent
        return np.asarray(1 / (values + 1j * loss * w * np.sqrt(values) - w**2))

    def accelerations(
        self,
        frequency: float,
        points: Reals,
        *,
        fingers: Reals | None = None,
        loads: Complexes | None = None,
    ) -> Complexes:
        """Acceleration at points (p, 2) per base displacement of each ERA, its gain included.

        (p, n) [1/s²]; fingers (k, 2) [m] with dynamic stiffness loads (k,) [N/m].
        """
        w, n = 2 * np.pi * frequency, len(self.at)
        base = self.stiffness + 1j * w * self.damping
        held: list[Complexes | Reals] = [base - w**2 * self.bolt, -(w**2) * self.masses[:, 2]]
        shapes = self.attached
        if fingers is not None and loads is not None:
            shapes = np.vstack([shapes, self.plate.shapes(fingers)])
            held.append(loads)
        Z = np.concatenate(held)
        modal = self.receptance(frequency)
        system = np.eye(len(Z)) + Z[:, None] * ((shapes * modal) @ shapes.T)
        applied = np.zeros((len(Z), n), dtype=complex)
        applied[np.arange(n), np.arange(n)] = base * self.gain
        forces = np.linalg.solve(system, applied)
        return np.asarray(-(w**2) * (self.plate.shapes(points) * modal) @ (shapes.T @ forces))


LENGTH, WIDTH, THICKNESS = 0.3048, 0.2286, 0.0015
MODULUS, DENSITY, RATIO = 70e9, 2700.0, 0.33
STIFFNESS, DAMPING_RATIO, LOSS = 17_000.0, 0.05, 0.01
CORNERS = np.array([(0, 0), (LENGTH, 0), (LENGTH, WIDTH), (0, WIDTH)])
FAMILY = ("plain", "form", "hard", "uneven")
SETS = (*FAMILY, "wedge", "bumps", "frame", "loose", "heavy", "two")
PLAIN = ("plain", "frame")  # no form errors
TAPER = {"uneven": 0.015, "wedge": 0.03}  # of the thickness, from the middle to the ends
BUMPS, BUMP = (5, 4), 0.03  # of the thickness, standard deviation of each of so many fields
FRAME, FRAME_STIFFER, FRAME_HEAVIER = 12e-3, 0.8, 0.35
LOOSE = 0.35  # of its spring and damper
HEAVY = {"heavy": [10e-3], "two": [5e-3, 5e-3]}
INSIDE = np.array([(0.31, 0.37), (0.68, 0.59)]) * (LENGTH, WIDTH)
"""Places of sensors that are not at ERAs."""
NOISE, FLOOR = 0.01, 0.001
PULP, PULP_DAMPING, CONTACT, PHALANX, JOINT, JOINT_DAMPING = 1000.0, 2.0, 2e-4, 5e-3, 500.0, 2.0


@dataclass(frozen=True, eq=False)
class Hidden:
    """A plate as it is: mounted, with the gains of sensors at its ERAs (n,) and of those INSIDE."""

    mounted: Mounted
    sensor_gain: Complexes
    inside_gain: Complexes

    def measured(
        self, frequencies: Reals, rng: np.random.Generator, sensors: int = len(CORNERS)
    ) -> Complexes:
        """Responses at ERAs, and INSIDE at more sensors than these (f, s, n) [1/s²], with noise."""
        at = np.vstack([self.mounted.at, INSIDE])[:sensors]
        clean = np.array([self.mounted.accelerations(f, at) for f in frequencies])
        clean *= np.append(self.sensor_gain, self.inside_gain)[:sensors, None]
        rms = np.sqrt((np.abs(clean) ** 2).mean(axis=(0, 2)))[:, None]
        noise = rng.standard_normal((2, 2, *clean.shape))
        parts = noise[:, 0] + 1j * noise[:, 1]
        return np.asarray(clean + NOISE * np.abs(clean) * parts[0] + FLOOR * rms * parts[1])


def draw(kind: str, seed: int) -> Hidden:
    """Draw a plate of a set.

    Plain, form (places and a hidden mass), hard (all else, too), or form with what the model has
    not: uneven and wedge (tapered), bumps (of thickness), loose (one ERA) or with other masses:
    heavy (10 g) and two (of 5 g); or frame (plain but for one bonded along the edges).
    """
    rng = np.random.default_rng([seed, SETS.index(kind)])
    normal = rng.standard_normal
    n, hard = len(CORNERS), kind == "hard"
    thick = 1 + 0.02 * normal()
    stiff = np.maximum(1 + 0.1 * normal(n), 0.3)
    damped, lossy = 1.5 ** normal(), 1.5 ** normal()
    each = np.exp(0.2 * normal(n))
    gain = (1 + 0.05 * normal(n)) * np.exp(1j * np.radians(5) * normal(n))
    sensor = (1 + 0.05 * normal(n)) * np.exp(1j * np.radians(5) * normal(n))
    inwards = np.abs(1.5e-3 * normal((n, 2))) * (kind not in PLAIN)
    mass = np.array([[*(rng.uniform(0.03, 0.97, 2) * (LENGTH, WIDTH)), 3e-3]])
    sides = np.array([LENGTH, WIDTH]) + hard * 0.5e-3 * normal(2)
    ratio, modulus = RATIO + hard * 0.015 * normal(), MODULUS * (1 + hard * 0.02 * normal())
    bolt, exponent = hard * np.abs(0.5e-3 * normal(n)), hard * 0.3 * normal()
    thickest = rng.uniform(0, 2 * np.pi)
    taper = TAPER.get(kind, 0.0) * np.array([np.cos(thickest), np.sin(thickest)])
    inside = (1 + 0.05 * normal(len(INSIDE))) * np.exp(1j * np.radians(5) * normal(len(INSIDE)))
    if kind in HEAVY:
        weights = HEAVY[kind]
        at_random = rng.uniform(0.03, 0.97, (len(weights), 2)) * (LENGTH, WIDTH)
        mass = np.column_stack([at_random, weights])
    if kind == "loose":
        loose = rng.integers(n)
        stiff[loose] *= LOOSE
        each[loose] *= LOOSE
    plate = ThinPlate(
        *(sides[0], sides[1], THICKNESS * thick, modulus, DENSITY, ratio),
        parts=_parts(kind, (float(sides[0]), float(sides[1])), rng),
        taper=(float(taper[0]), float(taper[1])),
    )
    corners = np.where(CORNERS > 0, sides, 0.0)
    at = corners + np.where(CORNERS > 0, -inwards, inwards)
    damping = 2 * DAMPING_RATIO * np.sqrt(STIFFNESS * LENGTH * WIDTH * THICKNESS * DENSITY / n)
    mounted = Mounted(
        plate,
        at,
        STIFFNESS * stiff,
        damping * damped * each,
        bolt,
        gain,
        mass if kind not in PLAIN else mass[:0],
        LOSS * lossy,
        exponent,
    )
    return Hidden(mounted, sensor, inside)


def _parts(
    kind: str, sides: tuple[float, float], rng: np.random.Generator
) -> tuple[tuple[float, ...], ...]:
    """Parts of a plate with a bonded frame, or of one with bumps."""
    length, width = sides
    if kind == "frame":
        inner = (FRAME, length - FRAME, FRAME, width - FRAME)
        return (
            (0.0, length, 0.0, width, FRAME_STIFFER, FRAME_HEAVIER),
            (*inner, -FRAME_STIFFER, -FRAME_HEAVIER),
        )
    if kind != "bumps":
        return ()
    x, y = (np.linspace(0, side, count + 1) for side, count in zip(sides, BUMPS, strict=True))
    thicker = BUMP * rng.standard_normal(BUMPS)
    return tuple(
        (*x[i : i + 2].tolist(), *y[j : j + 2].tolist(), (1 + t) ** 3 - 1, t)
        for (i, j), t in np.ndenumerate(thicker)
    )


def finger_stiffness(frequency: float, factors: Reals) -> complex:
    """Force per displacement of a finger, a contact mass on a pulp before a phalanx on its joint.

    factors (4,): on contact mass, pulp, phalanx, joint.
    """
    w, (mass, soft, bone, held) = 2 * np.pi * frequency, factors
    pulp = soft * (PULP + 1j * w * PULP_DAMPING)
    joint = held * (JOINT + 1j * w * JOINT_DAMPING)
    moved = pulp / (pulp + joint - w**2 * PHALANX * bone)
    return complex(-(w**2) * CONTACT * mass + pulp * (1 - moved))


def parameters_held(found: Identification, own: Mounted) -> dict[str, Reals]:
    """Errors in standard deviations by kind: springs and dampers over mass, gains, frequencies."""
    space, x, plate = found.fitted.space, found.fitted.x, found.before.plate
    mass = np.log(own.plate.thickness / plate.thickness)
    model = found.fitted.model
    elastic = np.sort(own.plate.modes[0])[3 : 3 + len(model.shifted_modes)]
    solved = model.free
    theory = solved.modes.eigenvalues[model.shifted_modes]
    # Of the plate as written: that solved is of the thickness found.
    theory = theory * (plate.thickness / solved.plate.thickness) ** 2
    theory = theory * plate.material.E / solved.plate.material.E
    gain = np.log(np.abs(own.gain))
    phase = np.angle(own.gain)
    true = {
        "frequency": np.log(elastic / theory) / 2,
        "stiffness": np.log(own.stiffness / [era.stiffness for era in found.before.eras]) - mass,
        "damping": np.log(own.damping / [era.damping for era in found.before.eras]) - mass,
        "gain": gain - gain.mean(),
        "phase": phase - phase.mean(),
    }
    errors, stds = {}, found.stds()
    for kind, value in true.items():
        estimate = relevant(space)[kind] @ (space.std * x)
        errors[kind] = (estimate - value) / stds[kind]
    places = space.groups["place"]
    written = np.array([(era.x, era.y) for era in found.before.eras])
    errors["place"] = (space.std[places] * x[places] - (own.at - written).ravel()) / stds["place"]
    if len(own.masses) and len(found.values["masses"]):
        x, y, weight = own.masses[0]
        at = space.groups["masses"].start
        off = found.values["masses"][0] - [weight, x, y]
        std = np.hypot(found.std[at : at + 3], [0.0, *[PARAMETER_KINDS["place"].theory] * 2])
        errors["mass"] = off / std
    return errors


@dataclass(frozen=True)
class Fault:
    """A fault of a kind of hidden plate: a taper, a further mass [kg], or a resting finger."""

    kind: str = "plain"
    taper: float = 0.0
    mass: float = 0.0
    has_finger: bool = False


FAULTS = {
    "none": Fault(),
    "none, with form errors and 3 g": Fault("form"),
    "bonded frame": Fault("frame"),
    "thickness ± 3 % from end to end": Fault(taper=0.03),
    "the same with form errors and 3 g": Fault("wedge"),
    "10 g": Fault(mass=10e-3),
    "twice 5 g, with form errors": Fault("two"),
    "a resting finger": Fault(has_finger=True),
}
"""Faults by name."""

FAULT_FREQUENCIES = np.linspace(45.0, 495.0, 16)
_SENSORS = np.array(
    [
        *([0.07, 0.15], [0.37, 0.08], [0.94, 0.12], [0.14, 0.44]),
        *([0.62, 0.41], [0.91, 0.57], [0.31, 0.80], [0.96, 0.93]),
    ]
) * (LENGTH, WIDTH)
_SENSOR_SCALE = 0.01
_SENSOR_PLACE = 0.5e-3  # m


def measured_fault(fault: Fault, seed: int) -> Measurement:
    """Responses of a hidden plate with a fault, read by eight accelerometers with 1 % of noise."""
    rng = np.random.default_rng([seed, 93])
    mounted = draw(fault.kind, seed).mounted
    at = rng.uniform(0.1, 0.9, 2) * (LENGTH, WIDTH)
    angle = rng.uniform(0, 2 * np.pi)
    if fault.taper:
        taper = (fault.taper * np.cos(angle), fault.taper * np.sin(angle))
        mounted = replace(mounted, plate=replace(mounted.plate, taper=taper))
    if fault.mass:
        mounted = replace(mounted, masses=np.array([[*at, fault.mass]]))
    positions = _SENSORS + _SENSOR_PLACE * rng.standard_normal(_SENSORS.shape)
    fingers = at[None] if fault.has_finger else None
    rows = []
    for frequency in FAULT_FREQUENCIES.tolist():
        load = np.array([finger_stiffness(frequency, np.ones(4))])
        rows.append(mounted.accelerations(frequency, positions, fingers=fingers, loads=load).T)
    scales = 1 + _SENSOR_SCALE * rng.standard_normal(len(_SENSORS))
    values = np.array(rows) * scales
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=2, keepdims=True))
    white = rng.standard_normal((2, *values.shape))
    values = values + NOISE * rms * (white[0] + 1j * white[1]) / np.sqrt(2)
    names = tuple(f"P{number}" for number in range(1, 1 + len(_SENSORS)))
    return Measurement(sensors_at(_SENSORS, names), FAULT_FREQUENCIES, values.swapaxes(1, 2))
