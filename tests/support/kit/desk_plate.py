"""The plate behind a sound card: samples of all outputs in, samples of all inputs out.

The true plate is drawn within what a rig's drawing leaves open; its accelerations become samples
with the noise, filter, delay and clipping of a sound card's inputs.

The linear system is sampled exactly, many samples by one product of a matrix: the input is straight
between samples (a hold of first order; one of zeroth order would be half a sample late). In the
eigenvectors of the system every mode is advanced exactly. With L samples in a block one real matrix
takes [state, L inputs] to [state, L outputs].

Coordinates q are those of the free plate (`ReducedPlate`) and the free end of each actuator that
has one, as the magnet of an exciter; then there are the drive y of each actuator, the base of an
ERA or the voltage of an exciter, and the phalanx of each finger. Actuators and fingers couple the
modes; their damping is not proportional. With the actuators' `InTime`,

    M q'' + C q' + K q = Phi_e^T (b y + b' y'),   y'' + 2 zeta w y' + w² y = g w² full level u

The drive is a state, so that accelerations follow from it: with it as input they would grow with
frequency.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import linalg, signal

from era_haptics.lab.measuring.desk import Desk
from era_haptics.lab.measuring.sensor_file import WiredSensor, are_positions
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.reduction.reduced_plate import ReducedPlate, reduce_plate
from model.rig.rig import Rig
from model.rig.rig_mesh import parse_mesh
from model.structure.attachments import footprints_of
from model.structure.fingertips import FingertipLoad, fingertip_loads
from model.structure.plate import Plate
from model.structure.sources import Era

_ORDER = 4
_CORNER = 0.42  # of the sample rate; anti-aliasing filters of converters pass all of the audio band


@dataclass(frozen=True)
class Converters:
    """What is between the plate and the samples.

    delay [samples]: of all channels; noise [m/s²/sqrt(Hz)]: of each accelerometer.
    """

    delay: int = 73
    noise: float = 5e-3

    def response(self, frequencies: FloatArray, *, rate: float) -> ComplexArray:
        """Closed-form response (f,) of filter and delay at frequencies [Hz]."""
        _, filtered = signal.freqz_sos(_filter(), worN=frequencies, fs=rate)
        angle = -2j * np.pi * np.asarray(frequencies) * self.delay / rate
        return np.asarray(filtered * np.exp(angle))


def _filter() -> FloatArray:
    return np.asarray(signal.butter(_ORDER, _CORNER, fs=1.0, output="sos"))


class SensorChannels:
    """Samples (n, inputs) of a sound card's inputs, block after block.

    Each sensor is on its input, the loop-back on its own (counted from 1), the rest is silent.
    """

    def __init__(
        self,
        sensors: Sequence[WiredSensor],
        *,
        loopback: int,
        converters: Converters,
        rate: float,
        seed: int,
    ) -> None:
        self.count = max(loopback, *(sensor.input for sensor in sensors))
        self._columns = [sensor.input - 1 for sensor in sensors]
        self._loopback = loopback - 1
        self._sensitivity = np.array([sensor.sensitivity for sensor in sensors])
        self._noise = converters.noise * np.sqrt(rate / 2)
        self._rng = np.random.default_rng([seed, 1])
        self._sos = _filter()
        self._memory = np.zeros((len(self._sos), 2, self.count))
        self._late = np.zeros((converters.delay, self.count))

    def samples(self, accelerations: FloatArray, looped: FloatArray) -> FloatArray:
        """Samples for accelerations (n, sensors) [m/s²] and what comes by the loop-back (n,)."""
        raw = np.zeros((len(looped), self.count))
        noise = self._noise * self._rng.standard_normal(accelerations.shape)
        raw[:, self._columns] = (accelerations + noise) * self._sensitivity
        raw[:, self._loopback] = looped
        filtered, self._memory = signal.sosfilt(self._sos, raw, axis=0, zi=self._memory)
        together = np.concatenate([self._late, filtered])
        self._late = together[len(looped) :]
        return np.asarray(np.clip(together[: len(looped)], -1.0, 1.0))


MESH = "16x12 Q3"
"""Elements of high order: another solver than the polynomials of a table."""

_RESONANCES = 550.0, 800.0  # Hz, of actuators; above the played range, but felt in its phases
_AMPLIFIERS = 2.5e3, 3.5e3  # Hz, of filters before exciters; far above the band
_MAGNET = 0.05
_RATIOS = 0.2, 0.4  # of their damping
_PLACE = 1e-3  # m
_BOLT = 0.008  # kg


@dataclass(frozen=True)
class Actuator:
    """The motion of an ERA's base by a sample: g w² / (s² + 2 zeta w s + w²) full strokes.

    resonance w / 2 pi [Hz], damping ratio zeta, gain g.
    """

    resonance: float
    ratio: float
    gain: float

    def response(self, frequencies: FloatArray) -> ComplexArray:
        """Full strokes by full scale at frequencies [Hz]."""
        x = np.asarray(frequencies) / self.resonance
        return np.asarray(self.gain / (1 - x**2 + 2j * self.ratio * x))


@dataclass(frozen=True)
class Truth:
    """A plate on its ERAs as it is: a rig without measured gains, and an actuator of each ERA."""

    rig: Rig
    actuators: tuple[Actuator, ...]

    def as_json(self) -> Mapping[str, object]:
        """Its parameters, as those that `era calibrate` finds, for programs."""
        plate = self.rig.plate
        return {
            "thickness_m": plate.thickness,
            "flexural_rigidity_n_m": plate.flexural_rigidity,
            "loss_factor": plate.loss_factor,
            "eras": {
                era.name: {
                    "at_m": [era.x, era.y],
                    **{kind: getattr(era, field) for kind, field in era.fields.items()},
                    "resonance_hz": actuator.resonance,
                    "damping_ratio": actuator.ratio,
                    "gain": actuator.gain,
                }
                for era, actuator in zip(self.rig.eras, self.actuators, strict=True)
            },
        }


def draw_truth(rig: Rig, *, seed: int, mesh: str = MESH) -> Truth:
    """Draw a plate of a rig: by the rig's uncertainty, with places, bolts and actuators of its own.

    Places are off by 1 mm (standard deviation), bolts weigh up to 8 g more, magnets of exciters
    differ by 5 %.
    """
    rng = np.random.default_rng(seed)
    std = rig.uncertainty

    def relative(deviation: float) -> float:
        return float(max(0.05, 1 + deviation * rng.standard_normal()))

    plate = rig.plate.scaled(thickness=relative(std.thickness))
    loss = min(plate.loss_factor * std.damping ** rng.standard_normal(), 0.5)
    plate = replace(plate, loss_factor=float(loss))
    damping = std.damping ** rng.standard_normal()
    eras = []
    for era in rig.eras:
        x, y = _near((era.x, era.y), plate, rng)
        changes: dict[str, Any] = {
            "x": x,
            "y": y,
            "stiffness": era.stiffness * relative(std.stiffness),
            "damping": float(era.damping * damping * relative(std.stiffness)),
        }
        if isinstance(era, Era):
            changes["bolt_mass"] = era.bolt_mass + float(rng.uniform(0, _BOLT))
        else:
            changes["magnet_mass"] = era.magnet_mass * relative(_MAGNET)
        eras.append(replace(era, gains=(), **changes))
    actuators = tuple(
        Actuator(
            float(rng.uniform(*(_RESONANCES if isinstance(era, Era) else _AMPLIFIERS))),
            float(rng.uniform(*_RATIOS)),
            relative(std.gain),
        )
        for era in eras
    )
    return Truth(
        replace(rig, plate=plate, eras=tuple(eras), mesh=parse_mesh(mesh, plate)), actuators
    )


def _near(place: Sequence[float], plate: Plate, rng: np.random.Generator) -> tuple[float, float]:
    """A place beside another, on the plate."""
    found = np.abs(np.asarray(place) + _PLACE * rng.standard_normal(2))
    sides = np.array([plate.length, plate.width])
    x, y = np.where(found > sides, 2 * sides - found, found).tolist()
    assert math.isfinite(x + y)
    return x, y


FREQUENCY_MAX = 1000.0
"""Hz; of the response, modes are kept to twice that."""


@dataclass(frozen=True, eq=False)
class ModelInTime:
    """x' = A x + B u, accelerations C x [m/s²] at points.

    A (n, n), B (n, eras), C (points, n); x has displacements and velocities of the coordinates of
    plate and free ends, then of the drives, then of the phalanges.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray

    def response(self, frequencies: FloatArray) -> ComplexArray:
        """Accelerations by full scale at frequencies [Hz] in continuous time, (f, points, eras)."""
        s = 2j * np.pi * np.asarray(frequencies)
        eye = np.eye(len(self.A))
        return np.array([self.C @ np.linalg.solve(each * eye - self.A, self.B) for each in s])


class DeskModel:
    """The plate of a truth, solved once; fingers come and go.

    points (p, 2) [m]: of the accelerometers.
    """

    def __init__(self, truth: Truth, points: FloatArray) -> None:
        rig = truth.rig
        self._truth = truth
        attached = footprints_of(rig.eras, rig.masses)
        self._plate: ReducedPlate = reduce_plate(
            rig.plate, rig.mesh, attached, frequency_max=FREQUENCY_MAX
        )
        far = [(n, era.in_time.far_mass) for n, era in enumerate(rig.eras)]
        self._far_masses = np.array([mass for _, mass in far if mass is not None])
        self._at_attached = self._extended(self._plate.at(attached))
        self._at_points = self._extended(self._plate.at(points))
        free = [n for n, mass in far if mass is not None]
        # Forces of an actuator push its two ends apart.
        self._at_attached[free, len(self._plate.omega) :] = -np.eye(len(free))

    def _extended(self, shapes: FloatArray) -> FloatArray:
        """Shapes of the plate (p, r) in all coordinates, in which free ends are at rest."""
        return np.hstack([shapes, np.zeros((len(shapes), len(self._far_masses)))])

    @property
    def _size(self) -> int:
        """Number of coordinates of plate and free ends."""
        return len(self._plate.omega) + len(self._far_masses)

    @property
    def shared(self) -> int:
        """Number of the first states, which are the same under any fingers."""
        return 2 * self._size + 2 * len(self._truth.rig.eras)

    def under(
        self, fingers: Sequence[FingertipLoad] = (), *, moved: tuple[int, float] | None = None
    ) -> ModelInTime:
        """The plate with fingers on it.

        moved: the only point with an accelerometer now, by its number, and its mass [kg].
        """
        rig, r = self._truth.rig, self._size
        count = len(rig.eras)
        at_eras, at_masses = self._at_attached[:count], self._at_attached[count:]
        k, c, m, inertance, by_drive, by_rate = (
            np.array([getattr(era.in_time, key) for era in rig.eras])
            for key in ("stiffness", "damping", "mass", "inertance", "by_drive", "by_rate")
        )
        plain = self._extended(at_eras[:, : len(self._plate.omega)])  # of the plate's ends alone
        mass = linalg.block_diag(np.eye(len(self._plate.omega)), np.diag(self._far_masses))
        mass += (plain.T * m) @ plain + (at_eras.T * inertance) @ at_eras
        damping = (at_eras.T * c) @ at_eras
        stiffness = np.diag(self._elastic) + (at_eras.T * k) @ at_eras
        for load, shape in zip(rig.masses, at_masses, strict=True):
            mass += load.mass * np.outer(shape, shape)
            damping += load.damping * np.outer(shape, shape)
            stiffness += load.stiffness * np.outer(shape, shape)
        damping += self._structural(mass, stiffness)
        at_points = self._at_points
        if moved is not None:
            number, weight = moved
            at_points = at_points[[number]]
            mass += weight * at_points.T @ at_points

        contacts = np.empty((0, r))
        if fingers:
            contacts = self._extended(self._plate.at(footprints_of(fingers)))
        p = len(fingers)
        n = 2 * r + 2 * count + 2 * p
        A, B = np.zeros((n, n)), np.zeros((n, count))
        q, v = slice(0, r), slice(r, 2 * r)
        y, w = (slice(2 * r + i * count, 2 * r + (i + 1) * count) for i in (0, 1))
        x, u = (slice(2 * r + 2 * count + i * p, 2 * r + 2 * count + (i + 1) * p) for i in (0, 1))
        tips = [finger.fingertip for finger in fingers]
        pulp, loss = np.array([t.stiffness for t in tips]), np.array([t.damping for t in tips])
        for tip, shape in zip(tips, contacts, strict=True):
            mass += tip.contact_mass * np.outer(shape, shape)
            damping += tip.damping * np.outer(shape, shape)
            stiffness += tip.stiffness * np.outer(shape, shape)

        force = np.zeros((r, n))
        force[:, q], force[:, v] = -stiffness, -damping
        force[:, y], force[:, w] = at_eras.T * by_drive, at_eras.T * by_rate
        force[:, x], force[:, u] = contacts.T * pulp, contacts.T * loss
        motion = linalg.solve(mass, force, assume_a="pos")
        A[q, v], A[v] = np.eye(r), motion

        omega = 2 * np.pi * np.array([each.resonance for each in self._truth.actuators])
        ratio, gain = (
            np.array([getattr(each, key) for each in self._truth.actuators])
            for key in ("ratio", "gain")
        )
        strokes = np.array([era.full_level for era in rig.eras])
        A[y, w] = np.eye(count)
        A[w, y], A[w, w] = -np.diag(omega**2), -np.diag(2 * ratio * omega)
        B[w] = np.diag(gain * omega**2 * strokes)

        A[x, u] = np.eye(p)
        for row, (tip, shape) in enumerate(zip(tips, contacts, strict=True), start=u.start):
            phalanx = row - p
            A[row, q] = tip.stiffness / tip.phalanx_mass * shape
            A[row, v] = tip.damping / tip.phalanx_mass * shape
            A[row, phalanx] = -(tip.stiffness + tip.joint_stiffness) / tip.phalanx_mass
            A[row, row] = -(tip.damping + tip.joint_damping) / tip.phalanx_mass
        return ModelInTime(A, B, at_points @ motion)

    @property
    def _elastic(self) -> FloatArray:
        """Eigenvalues of the plate [rad²/s²], none of free ends."""
        return np.append(self._plate.omega**2, np.zeros(len(self._far_masses)))

    def _structural(self, mass: FloatArray, stiffness: FloatArray) -> FloatArray:
        """Viscous damping that loses at each resonance of the supported plate what eta does.

        eta K_plate between modes j and k of the supported plate, over sqrt(omega_j omega_k).
        """
        values, modes = linalg.eigh(stiffness, mass)
        elastic = (modes.T * self._elastic) @ modes * self._truth.rig.plate.loss_factor
        roots = np.maximum(values, 1e-3) ** 0.25
        weighted = mass @ modes
        return np.asarray(weighted @ (elastic / np.outer(roots, roots)) @ weighted.T)


SAMPLES = 16
"""In a product: larger matrices leave the cache."""


@dataclass(frozen=True, eq=False)
class SampledModel:
    """z[n + 1] = E z[n] + B u[n], a[n] = Re(C z[n]) + D u[n], of the modes with Im >= 0.

    E (m,), B (m, inputs), C (outputs, m), D (outputs, inputs); rate [Hz]. to_modes (m, n): of a
    state x without input; to_state (n, m): x is the real part.
    """

    E: ComplexArray
    B: ComplexArray
    C: ComplexArray
    D: FloatArray
    rate: float
    to_modes: ComplexArray
    to_state: ComplexArray

    def response(self, frequencies: FloatArray) -> ComplexArray:
        """Closed-form response of the samples at frequencies [Hz], (f, outputs, inputs)."""
        z = np.exp(2j * np.pi * np.asarray(frequencies) / self.rate)[:, None, None]
        both = (
            C * (1 / (z - E)) @ B
            for E, B, C in (
                (self.E, self.B, self.C),
                (self.E.conj(), self.B.conj(), self.C.conj()),
            )
        )
        return np.asarray(sum(both) / 2 + self.D)

    @cached_property
    def lifted(self) -> FloatArray:
        """The matrix of a block: (state + SAMPLES outputs, state + SAMPLES inputs)."""
        m, (outputs, inputs) = len(self.E), self.D.shape
        powers = self.E ** np.arange(SAMPLES + 1)[:, None]
        state, n_in, n_out = 2 * m, SAMPLES * inputs, SAMPLES * outputs
        found = np.zeros((state + n_out, state + n_in))
        last = np.diag(powers[SAMPLES])
        found[:state, :state] = np.block([[last.real, -last.imag], [last.imag, last.real]])
        for n in range(SAMPLES):
            column = state + inputs * n
            arriving = powers[SAMPLES - 1 - n][:, None] * self.B
            found[:state, column : column + inputs] = np.vstack([arriving.real, arriving.imag])
            row = state + outputs * n
            leaving = self.C * powers[n]
            found[row : row + outputs, :state] = np.hstack([leaving.real, -leaving.imag])
            for later in range(n, SAMPLES):
                to = state + outputs * later
                pulse = self.D if later == n else ((self.C * powers[later - n - 1]) @ self.B).real
                found[to : to + outputs, column : column + inputs] = pulse
        return found


def sampled(model: ModelInTime, *, rate: float) -> SampledModel:
    """Sample a model at a rate [Hz].

    With phi1 = (e - 1) / s, phi2 = (e - 1 - s T) / (s² T), e = exp(s T), of an eigenvalue s, and
    z[n] less phi2 b u[n] as the state, the sample of u at n + 1 is not needed at n.
    """
    values, vectors = linalg.eig(model.A)
    inverse = linalg.inv(vectors)
    upper = values.imag >= 0
    double = np.where(values.imag > 0, 2.0, 1.0)[upper]
    s, step = values[upper], 1 / rate
    e = np.exp(s * step)
    phi1 = np.expm1(s * step) / s
    phi2 = (phi1 - step) / (s * step)
    b = inverse[upper] @ model.B
    to_state = vectors[:, upper] * double
    c = model.C @ to_state
    B = (e * phi2 + phi1 - phi2)[:, None] * b
    D = ((c * phi2) @ b).real
    return SampledModel(e, B, c, D, rate, inverse[upper], to_state)


class LiftedBlocks:
    """Advances a sampled model from rest, in multiples of SAMPLES samples."""

    def __init__(self, model: SampledModel) -> None:
        self._model = model
        self._lifted = model.lifted
        self._state = np.zeros(2 * len(model.E))

    def advance(self, samples: FloatArray) -> FloatArray:
        """Accelerations (n, outputs) for samples (n, inputs); n a multiple of SAMPLES."""
        size, (outputs, inputs) = len(self._state), self._model.D.shape
        rows = np.ascontiguousarray(samples, dtype=float).reshape(-1, SAMPLES * inputs)
        found = np.empty((len(rows), SAMPLES * outputs))
        for row, into in zip(rows, found, strict=True):
            after = self._lifted @ np.concatenate([self._state, row])
            self._state, into[:] = after[:size], after[size:]
        return found.reshape(-1, outputs)

    def carry_on(self, before: "LiftedBlocks", count: int) -> None:
        """Continue from another model whose first states (count,) are the same; the rest is zero.

        What the last sample adds within its interval is left out.
        """
        m = len(before._model.E)
        x = (before._model.to_state @ (before._state[:m] + 1j * before._state[m:])).real
        modes = self._model.to_modes[:, :count] @ x[:count]
        self._state = np.concatenate([modes.real, modes.imag])


_LOOPED = 0.9  # of what a cable from an output to an input brings back


class DeskPlate:
    """A plate with accelerometers, a loop-back cable, and fingers on request.

    Outputs and inputs of the card are those of a `Desk`; is_shared: the loop-back is a Y-cable
    beside the last ERA. rate [Hz]. One sensor that is
    moved is at the first of its places, with its mass, and off the plate while it is touched.
    `advance` and all else may be called by different threads.
    """

    def __init__(
        self,
        truth: Truth,
        sensors: Sequence[WiredSensor],
        *,
        rate: float,
        converters: Converters,
        seed: int,
        is_shared: bool = False,
    ) -> None:
        self._truth, self._rate = truth, rate
        wiring = Desk(truth.rig, tuple(sensors), is_shared).wiring
        self._columns = [output - 1 for output in wiring.era_outputs.values()]
        self._looped = wiring.source_outputs[-1] - 1
        self.outputs = wiring.loopback_output
        self._model = DeskModel(truth, np.array([[sensor.x, sensor.y] for sensor in sensors]))
        self._sensors = tuple(sensors)
        self._fingers: tuple[FingertipLoad, ...] = ()
        self._place = 0 if are_positions(sensors) else None
        self._channels = SensorChannels(
            sensors if self._place is None else sensors[:1],
            loopback=wiring.loopback_input,
            converters=converters,
            rate=rate,
            seed=seed,
        )
        self.inputs = self._channels.count
        self._next: LiftedBlocks | None = None
        self._plate = self._now()
        self._kept = self._model.shared

    def set_fingers(self, positions: Sequence[tuple[float, float]]) -> None:
        """Replace the fingers on the plate, at positions [m]; swapped between two blocks.

        The plate's motion is continuous; phalanges begin at rest.
        """
        self._fingers = fingertip_loads(self._truth.rig.fingertip, positions)
        self._next = self._now()

    def move_sensor(self, name: str) -> None:
        """Put a sensor that is moved to another of its places; raises InputError."""
        names = [sensor.name for sensor in self._sensors]
        if self._place is None or name not in names:
            raise InputError(
                f"a sensor is moved to one of the places of one sensor, got {name!r} of "
                f"{', '.join(names)}"
            )
        self._place = names.index(name)
        self._next = self._now()

    def _now(self) -> LiftedBlocks:
        moved = None
        if self._place is not None:
            mass = 0.0 if self._fingers else self._sensors[self._place].mass
            moved = self._place, mass
        return LiftedBlocks(sampled(self._model.under(self._fingers, moved=moved), rate=self._rate))

    def advance(self, played: FloatArray) -> FloatArray:
        """Samples (n, inputs) for samples (n, outputs); n a multiple of 16."""
        following, self._next = self._next, None
        if following is not None:
            following.carry_on(self._plate, self._kept)
            self._plate = following
        accelerations = self._plate.advance(played[:, self._columns])
        return self._channels.samples(accelerations, _LOOPED * played[:, self._looped])


BLOCK_MULTIPLE = SAMPLES
"""Frames of a block must be a multiple of this."""
