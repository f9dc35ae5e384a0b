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
from model.estimate.relevant_quantities import relevant

Reals: TypeAlias = NDArray[np.float64]
Complexes: TypeAlias = NDArray[np.complex128]
Integrals: TypeAlias = dict[tuple[int, int], Reals]
"""Integrals of a derivative of one function and one of another, by the orders of both."""

ELEMENTS = (13, 10)
ORDERS = ((0, 0), (1, 1), (2, 2), (2, 0))


@dataclass(frozen=True, eq=False)
class Line:
    """Cubic Hermite elements on (0, length) [m]: deflection and slope at each node."""

    length: float
    elements: int

    @property
    def step(self) -> float:
        """Length of an element [m]."""
        return self.length / self.elements

    def integrals(self, *, margin: float, slope: float, power: int) -> Integrals:
        """Integrals over the line without a margin [m] at both ends.

        A factor (1 + slope u)^power, u from -1 to 1 along the line, is part of the integrand.
        """
        points, weights = np.polynomial.legendre.leggauss(6)
        size = 2 * (self.elements + 1)
        totals = {orders: np.zeros((size, size)) for orders in ORDERS}
        span = np.array([margin, self.length - margin]) / self.step
        for number in range(self.elements):
            low, high = np.clip(span - number, 0, 1)
            t = low + (high - low) * (points + 1) / 2
            u = 2 * (number + t) / self.elements - 1
            lengths = (high - low) * self.step * weights / 2
            factors = lengths * (1 + slope * u) ** power
            dofs = slice(2 * number, 2 * number + 4)
            for (row_order, column_order), total in totals.items():
                rows = self._local(t, row_order)
                columns = self._local(t, column_order)
                total[dofs, dofs] += rows.T @ (factors[:, None] * columns)
        return totals

    def at(self, x: Reals) -> Reals:
        """Values of all functions at x (p,), beyond an end at it, (p, 2 nodes)."""
        x = np.clip(x, 0.0, self.length)
        element = np.clip((x / self.step).astype(int), 0, self.elements - 1)
        values = np.zeros((len(x), 2 * (self.elements + 1)))
        rows = np.arange(len(x))[:, None]
        dofs = 2 * element[:, None] + np.arange(4)
        values[rows, dofs] = self._local(x / self.step - element, 0)
        return values

    def _local(self, t: Reals, order: int) -> Reals:
        """The four functions of an element at t in (0, 1), or their derivatives, (q, 4)."""
        h = self.step
        cubics = np.array([[1, 0, -3, 2], [0, h, -2 * h, h], [0, 0, 3, -2], [0, 0, -h, h]])
        columns = []
        for cubic in cubics:
            derivative = np.polynomial.polynomial.polyder(cubic, order)
            columns.append(np.polynomial.polynomial.polyval(t, derivative))
        return np.asarray(np.array(columns).T / h**order, dtype=float)


@dataclass(frozen=True)
class Frame:
    """A frame along the edges: its width [m], and what it adds to rigidity and mass, relative."""

    width: float = 12e-3
    rigidity: float = 0.8
    mass: float = 0.35


@dataclass(frozen=True, eq=False)
class ThinPlate:
    """A free plate: sides, thickness [m], E [Pa], rho [kg/m³], nu.

    taper: thickness that each side's ends have more or less than its middle, relative.
    """

    length: float
    width: float
    thickness: float
    modulus: float
    density: float
    ratio: float
    taper: tuple[float, float] = (0.0, 0.0)
    frame: Frame | None = None

    @cached_property
    def _lines(self) -> tuple[Line, Line]:
        along, across = ELEMENTS
        return Line(self.length, along), Line(self.width, across)

    @cached_property
    def modes(self) -> tuple[Reals, Reals]:
        """Eigenvalues omega² (r,) [rad²/s²] and modes (size, r) of modal mass 1."""
        stiffness, mass = self._matrices(margin=0.0)
        if self.frame is not None:
            inner_stiffness, inner_mass = self._matrices(margin=self.frame.width)
            stiffness = stiffness + self.frame.rigidity * (stiffness - inner_stiffness)
            mass = mass + self.frame.mass * (mass - inner_mass)
        rigidity = self.modulus * self.thickness**3 / 12 / (1 - self.ratio**2)
        surface_density = self.density * self.thickness
        values, vectors = linalg.eigh(rigidity * stiffness, surface_density * mass)
        values[:3] = 0.0
        return values, vectors

    def _matrices(self, *, margin: float) -> tuple[Reals, Reals]:
        """Stiffness at a rigidity of 1 and mass at a density of 1, without a margin [m]."""
        bending, inertia = [], []
        for line, slope in zip(self._lines, self.taper, strict=True):
            bending.append(line.integrals(margin=margin, slope=slope, power=3))
            inertia.append(line.integrals(margin=margin, slope=slope, power=1)[0, 0])
        x, y = bending
        mixed = np.kron(x[2, 0], y[2, 0].T)
        bent = np.kron(x[2, 2], y[0, 0]) + np.kron(x[0, 0], y[2, 2])
        bent += self.ratio * (mixed + mixed.T)
        twisted = 2 * (1 - self.ratio) * np.kron(x[1, 1], y[1, 1])
        return np.asarray(bent + twisted), np.asarray(np.kron(*inertia))

    def shapes(self, points: Reals) -> Reals:
        """Mode shapes at points (p, 2) [m], (p, r)."""
        along, across = self._lines
        x_functions, y_functions = along.at(points[:, 0]), across.at(points[:, 1])
        products = x_functions[:, :, None] * y_functions[:, None, :]
        _, vectors = self.modes
        return np.asarray(products.reshape(len(points), -1) @ vectors)


@dataclass(frozen=True, eq=False)
class Mounted:
    """A plate on n ERAs with masses.

    at (n, 2) [m]; stiffness, damping, gain (n,); masses (m, 3): x, y [m] and mass [kg].
    """

    plate: ThinPlate
    at: Reals
    stiffness: Reals
    damping: Reals
    gain: Complexes
    masses: Reals
    loss: float

    def accelerations(
        self,
        frequency: float,
        points: Reals,
        *,
        fingers: Reals | None = None,
    ) -> Complexes:
        """Acceleration at points (p, 2) per base displacement of each ERA, its gain included.

        (p, n) [1/s²]; fingers (k, 2) [m].
        """
        w, count = 2 * np.pi * frequency, len(self.at)
        base = self.stiffness + 1j * w * self.damping
        places = [self.at, self.masses[:, :2]]
        attached = [base, -(w**2) * self.masses[:, 2]]
        if fingers is not None:
            places.append(fingers)
            attached.append(np.full(len(fingers), finger_stiffness(frequency)))
        dynamic_stiffness = np.concatenate(attached)
        shapes = self.plate.shapes(np.vstack(places))
        eigenvalues, _ = self.plate.modes
        receptances = 1 / (eigenvalues + 1j * self.loss * w * np.sqrt(eigenvalues) - w**2)
        compliance = (shapes * receptances) @ shapes.T
        system = np.eye(len(shapes)) + dynamic_stiffness[:, None] * compliance
        applied = np.zeros((len(shapes), count), dtype=complex)
        np.fill_diagonal(applied, base * self.gain)
        forces = np.linalg.solve(system, applied)
        at_points = self.plate.shapes(points) * receptances
        return np.asarray(-(w**2) * at_points @ (shapes.T @ forces))


def finger_stiffness(frequency: float) -> complex:
    """Force per displacement of a finger: a contact mass on a pulp, a phalanx on its joint."""
    w = 2 * np.pi * frequency
    pulp = 1000.0 + 2.0j * w  # N/m
    joint = 500.0 + 2.0j * w
    phalanx_share = pulp / (pulp + joint - w**2 * 5e-3)
    return complex(pulp * (1 - phalanx_share) - w**2 * 2e-4)


LENGTH, WIDTH, THICKNESS = 0.3048, 0.2286, 0.0015
MODULUS, DENSITY, RATIO = 70e9, 2700.0, 0.33
STIFFNESS, DAMPING_RATIO, LOSS = 17_000.0, 0.05, 0.01
CORNERS = np.array([(0, 0), (LENGTH, 0), (LENGTH, WIDTH), (0, WIDTH)])
MASSES = {
    "plain": [],
    "frame": [],
    "form": [3e-3],
    "uneven": [3e-3],
    "wedge": [3e-3],
    "two": [5e-3, 5e-3],
}
"""Hidden masses [kg] of each kind of plate."""
TAPER = {"uneven": 0.015, "wedge": 0.03}  # of the thickness, from the middle to the ends
NOISE, FLOOR = 0.01, 0.001


@dataclass(frozen=True, eq=False)
class Hidden:
    """A plate as it is: mounted, with the gains of sensors at its ERAs (n,)."""

    mounted: Mounted
    sensor_gain: Complexes

    def measured(self, frequencies: Reals, rng: np.random.Generator) -> Complexes:
        """Responses at ERAs (f, n, n) [1/s²], with noise."""
        mounted = self.mounted
        exact = np.array([mounted.accelerations(f, mounted.at) for f in frequencies])
        exact *= self.sensor_gain[:, None]
        rms = np.sqrt((np.abs(exact) ** 2).mean(axis=(0, 2)))[:, None]
        real, imaginary = rng.standard_normal((2, 2, *exact.shape))
        relative_noise, floor_noise = real + 1j * imaginary
        noise = NOISE * np.abs(exact) * relative_noise + FLOOR * rms * floor_noise
        return np.asarray(exact + noise)


def draw(kind: str, seed: int) -> Hidden:
    """Draw a plate of a kind.

    All but plain and frame have form errors: ERAs that are off inwards, and hidden masses. Uneven
    and wedge are tapered as well; a frame is bonded along the edges.
    """
    rng = np.random.default_rng([seed, [*MASSES].index(kind)])
    normal = rng.standard_normal
    count = len(CORNERS)

    def gains() -> Complexes:
        phases = np.radians(5) * normal(count)
        return np.asarray((1 + 0.05 * normal(count)) * np.exp(1j * phases))

    plate = ThinPlate(LENGTH, WIDTH, THICKNESS * (1 + 0.02 * normal()), MODULUS, DENSITY, RATIO)
    angle = rng.uniform(0, 2 * np.pi)
    taper = TAPER.get(kind, 0.0)
    plate = replace(plate, taper=(taper * np.cos(angle), taper * np.sin(angle)))
    if kind == "frame":
        plate = replace(plate, frame=Frame())
    inwards = np.abs(1.5e-3 * normal((count, 2)))
    if kind in ("plain", "frame"):
        inwards[:] = 0.0
    weights = np.array(MASSES[kind])
    at_random = rng.uniform(0.03, 0.97, (len(weights), 2)) * (LENGTH, WIDTH)
    plate_mass = LENGTH * WIDTH * THICKNESS * DENSITY
    damping = 2 * DAMPING_RATIO * np.sqrt(STIFFNESS * plate_mass / count)
    mounted = Mounted(
        plate,
        at=CORNERS + np.where(CORNERS > 0, -inwards, inwards),
        stiffness=STIFFNESS * np.maximum(1 + 0.1 * normal(count), 0.3),
        damping=damping * 1.5 ** normal() * np.exp(0.2 * normal(count)),
        gain=gains(),
        masses=np.column_stack([at_random, weights]),
        loss=LOSS * 1.5 ** normal(),
    )
    return Hidden(mounted, gains())


def standard_errors_off(found: Identification, mounted: Mounted) -> dict[str, Reals]:
    """Errors in standard deviations of springs over the plate's mass, and of gains."""
    space, x, written = found.fitted.space, found.fitted.x, found.before
    mass = np.log(mounted.plate.thickness / written.plate.thickness)
    springs = np.array([era.stiffness for era in written.eras])
    gain = np.log(np.abs(mounted.gain))
    true_values = {
        "stiffness": np.log(mounted.stiffness / springs) - mass,
        "gain": gain - gain.mean(),
    }
    deviations = found.stds()
    errors = {}
    for kind, true_value in true_values.items():
        estimate = relevant(space)[kind] @ (space.std * x)
        errors[kind] = (estimate - true_value) / deviations[kind]
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
        rows.append(mounted.accelerations(frequency, positions, fingers=fingers).T)
    values = np.array(rows) * (1 + _SENSOR_SCALE * rng.standard_normal(len(_SENSORS)))
    rms = np.sqrt((np.abs(values) ** 2).mean(axis=2, keepdims=True))
    real, imaginary = rng.standard_normal((2, *values.shape))
    values = values + NOISE * rms * (real + 1j * imaginary) / np.sqrt(2)
    names = tuple(f"P{number}" for number in range(1, 1 + len(_SENSORS)))
    return Measurement(sensors_at(_SENSORS, names), FAULT_FREQUENCIES, values.swapaxes(1, 2))
