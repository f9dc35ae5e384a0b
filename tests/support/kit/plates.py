"""Plates for tests: rigs and their files, tables, measured responses, and second solutions.

Also what fingers feel of answers on plates that deviate, each solved exactly at the tones played.

The founding paper's plate, also on a mesh that is quick to solve, with a table that is built in a
moment or in time on its ERAs; boards on exciters; a plate that is not quite the paper's, with
responses measured on it, sound ones and others that are not what they claim. Second solutions are a
stepping solver, bases that move in a way known twice, and scores of a drive tone by tone.
"""

import cmath
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from kit.direct_plate import direct_acceleration
from model.answer.answer import Answer
from model.answer.fingers_on_plate import FingersOnPlate
from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray, Point
from model.drive_forms import Forms, WeightedTones
from model.estimate.measurement import Measurement, sensors_at
from model.fem import ELEMENTS, Mesh, assemble
from model.finger import Grid, detection_threshold
from model.rig.rig import Channel, Rig
from model.rig.rig_file import example_rig_path, parse_rig
from model.structure.exciter import Exciter
from model.structure.fingertips import Fingertip, FingertipLoad
from model.structure.material import Material
from model.structure.plate import Plate
from model.structure.sources import Era, Gain, damping_from_ratio
from model.study.exact_plates import Plates, harmonics_on, powers_on
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.table.table_file import TableProblem, build_table, solve_table
from model.transients.base_motion import Motion as BaseMotionMotion
from model.transients.base_motion import Term, along_lines, raised_cosine
from model.vibration import Excitation
from registry.limits import GuardLimits

# Section 3 of the founding paper; stiffness recovered from its Table 2, damping and stroke assumed.
ALUMINIUM = Material("aluminium", E=70e9, rho=2700.0, nu=0.33)
LENGTH, WIDTH = 0.3048, 0.2286


def make_paper_rig(nx: int, ny: int, *, damping_ratio: float = 0.05) -> Rig:
    """The paper's plate with ERAs at its corners, on a mesh of nx by ny."""
    plate = Plate(LENGTH, WIDTH, 0.0015, ALUMINIUM, loss_factor=0.01)
    damping = damping_from_ratio(
        damping_ratio, stiffness=17000.0, plate_mass=plate.mass, era_count=4
    )
    corners = {"SW": (0.0, 0.0), "SE": (LENGTH, 0.0), "NE": (LENGTH, WIDTH), "NW": (0.0, WIDTH)}
    eras = tuple(
        Era(name, x, y, stiffness=17000.0, damping=damping, bolt_mass=0.0, stroke=100e-6)
        for name, (x, y) in corners.items()
    )
    wiring = {era.name: Channel("main", number) for number, era in enumerate(eras)}
    limits = GuardLimits(frequency_min=40.0, frequency_max=500.0, level=1.0)
    return Rig(plate, Mesh(nx, ny, LENGTH, WIDTH), eras, wiring, {"main": "sim://"}, limits)


FREQUENCIES = np.array([60.0, 110.0, 250.0])


def small_problem(*, nx: int = 12, ny: int = 9) -> TableProblem:
    """Three frequencies, twelve cells."""
    return TableProblem(make_paper_rig(nx, ny), FREQUENCIES, Grid(4, 3))


@cache
def small_table(*, drive_mode: str = "switched") -> LocalizationTable:
    """On the paper's own mesh."""
    return solve_table(small_problem(), drive_mode=drive_mode)


SMALL_TABLE_HZ = np.linspace(40.0, 500.0, 27)


def smooth_rig() -> Rig:
    """The paper's rig on 6x5 elements of the fifth order, promising by one set of thresholds."""
    rig = make_paper_rig(6, 5)
    mesh = Mesh(6, 5, rig.plate.length, rig.plate.width, ELEMENTS["Q5"])
    return replace(rig, mesh=mesh, promised_thresholds=(rig.threshold,))


def forms_of(table: LocalizationTable, placed: Placement, level_db_sl: float = 20.0) -> Forms:
    """Expected powers at fingertips, at all frequencies of a table."""
    fingers = FingersOnPlate.of(table, placed.contacts, placed.loads)
    formed = fingers.forms(np.arange(len(table.frequencies)), with_fine=True)
    every, count = range(len(placed.contacts)), len(placed.targets)
    return formed.of(every[:count], every[count:], level_db_sl)


@cache
def smooth_table() -> LocalizationTable:
    """Its table at 27 frequencies from 40 to 500 Hz."""
    return build_table(smooth_rig(), frequencies=SMALL_TABLE_HZ)


def contact_sets(
    count: int, *, fingers: int, seed: int, plate: Plate | None = None
) -> list[list[tuple[float, float]]]:
    """Fingertips anywhere on a plate, by default the paper's, at least 5 cm apart."""
    rng = np.random.default_rng(seed)
    plate = plate or smooth_rig().plate
    found: list[list[tuple[float, float]]] = []
    while len(found) < count:
        places = rng.uniform(0, [plate.length, plate.width], (fingers, 2))
        gaps = np.linalg.norm(places[:, None] - places, axis=-1)
        if gaps[np.triu_indices(fingers, 1)].min() >= 0.05:
            found.append([(float(x), float(y)) for x, y in places])
    return found


def write_rig(path: Path, *changes: tuple[str, str], mesh: str = "16x12") -> Path:
    """The example's text with these replacements, each of which must find something."""
    text = example_rig_path().read_text(encoding="utf-8")
    for old, new in (("mesh: auto", f"mesh: {mesh}"), *changes):
        assert old in text, old
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return path


TWO_AMPLIFIERS = (
    ('  main: {url: "sim://"}', '  main: {url: "sim://"}\n  side: {url: "sim://"}'),
    ("amplifier: main, channel: 2", "amplifier: side, channel: 0"),
    ("amplifier: main, channel: 3", "amplifier: side, channel: 1"),
)
"""The ERAs NE and NW on an amplifier of their own."""

ACRYLIC = "{name: acrylic, E: 4.5 GPa, rho: 1190, nu: 0.37}"

_PLACES = {"SW": (0.18, 0.24), "SE": (0.79, 0.17), "NE": (0.84, 0.78), "NW": (0.27, 0.81)}
_LENGTH, _WIDTH = 0.3, 0.23


def exciter_rig_text(
    keys: str = "type: DAEX13-4SM, power: 1 W", *, frequency: str = "[65, 300]", more: str = ""
) -> str:
    """The acrylic board of 300 x 230 x 5 mm on exciters with these keys."""
    exciters = [
        f"  {name}: {{kind: exciter, at: [{x * _LENGTH:g}, {y * _WIDTH:g}], amplifier: card, "
        f"channel: {channel}, {keys}}}"
        for channel, (name, (x, y)) in enumerate(_PLACES.items())
    ]
    feet = [
        f"  foam{number}: {{at: [{x}, {y}], stiffness: 2000, damping: 0.3}}"
        for number, (x, y) in enumerate(
            [(0, 0), (_LENGTH, 0), (_LENGTH, _WIDTH), (0, _WIDTH)], start=1
        )
    ]
    return "\n".join(
        [
            f"plate: {{length: {_LENGTH}, width: {_WIDTH}, thickness: 5 mm, material: {ACRYLIC}, "
            "loss_factor: 0.05}",
            "eras:",
            *exciters,
            *feet,
            'amplifiers: {card: {url: "sim://", full_level: output}}',
            f"limits: {{frequency: {frequency}}}",
            more,
        ]
    )


def exciter_rig(keys: str = "type: DAEX13-4SM, power: 1 W", **more: str) -> Rig:
    """The rig of that text."""
    return parse_rig("board.yaml", exciter_rig_text(keys, **more))


def as_sold(rig: Rig, rng: np.random.Generator, *, modulus: float) -> Rig:
    """The rig with exciters whose parts differ as sold ones do, by 20 % and 10 degrees.

    modulus: standard deviation of the logarithm of the board's own.
    """

    def factor(deviation: float) -> float:
        return float(np.exp(deviation * rng.standard_normal()))

    eras = []
    for era in rig.eras:
        assert isinstance(era, Exciter)
        parts = {
            key: factor(0.2) * getattr(era, key)
            for key in ("stiffness", "magnet_mass", "force_factor")
        }
        gains = ((100.0, factor(0.2), float(np.radians(10) * rng.standard_normal())),)
        eras.append(replace(era, gains=gains, **parts))
    return replace(rig, eras=tuple(eras), plate=rig.plate.scaled(modulus=factor(modulus)))


# Relative to the rig, bolt masses in kg: what assembly and ageing do.
STIFFNESS = (1.15, 0.9, 1.05, 0.82)
DAMPING = (1.4, 0.8, 1.1, 1.3)
BOLT_MASS = (0.012, 0.008, 0.015, 0.010)
MODULUS, LOSS_FACTOR = 1.07, 1.3

PERTURBED_PLATE_FREQUENCIES = np.arange(40.0, 501.0, 20.0)
# On no line of symmetry, so that every mode is seen.
POINTS = np.array(
    [
        *([0.021, 0.035], [0.114, 0.018], [0.205, 0.041], [0.287, 0.027]),
        *([0.043, 0.101], [0.129, 0.122], [0.188, 0.094], [0.276, 0.131]),
        *([0.017, 0.208], [0.096, 0.182], [0.217, 0.197], [0.293, 0.213]),
    ]
)
NAMES = tuple(f"P{number}" for number in range(1, len(POINTS) + 1))


def perturbed(
    rig: Rig, *, frequencies: np.ndarray = PERTURBED_PLATE_FREQUENCIES, seed: int = 1
) -> Rig:
    """The true rig, with gains of 8 % and 6 degrees at random at every frequency."""
    rng = np.random.default_rng(seed)
    eras = []
    for era, k, c, m in zip(rig.eras, STIFFNESS, DAMPING, BOLT_MASS, strict=True):
        gains = random_gains(rng, frequencies, size=0.08, phase=0.1)
        eras.append(
            replace(
                era,
                stiffness=k * era.stiffness,
                damping=c * era.damping,
                bolt_mass=m,
                gains=gains,
            )
        )
    material = replace(rig.plate.material, E=MODULUS * rig.plate.material.E)
    loss_factor = LOSS_FACTOR * rig.plate.loss_factor
    plate = replace(rig.plate, material=material, loss_factor=loss_factor)
    return replace(rig, plate=plate, eras=tuple(eras))


def random_gains(
    rng: np.random.Generator, frequencies: np.ndarray, *, size: float, phase: float
) -> tuple[Gain, ...]:
    """Gains at frequencies, off by standard deviations of their size and of their phase [rad]."""
    sizes = 1 + size * rng.standard_normal(len(frequencies))
    phases = phase * rng.standard_normal(len(frequencies))
    return tuple(zip(frequencies.tolist(), sizes.tolist(), phases.tolist(), strict=True))


def noise_like(values: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Complex white noise, a share of each row's rms over the sensors."""
    size = np.sqrt((np.abs(values) ** 2).mean(axis=2, keepdims=True))
    white = rng.standard_normal(values.shape) + 1j * rng.standard_normal(values.shape)
    return np.asarray(share * size * white / np.sqrt(2))


def measured(
    truth: Rig,
    *,
    frequencies: np.ndarray = PERTURBED_PLATE_FREQUENCIES,
    noise: float = 0.01,
    scales: Mapping[str, float] | None = None,
    seed: int = 2,
) -> Measurement:
    """Responses by one sparse solve a frequency, noise relative to each row's rms over sensors."""
    rng = np.random.default_rng(seed)
    matrices = assemble(truth.plate, truth.mesh)
    strokes = np.array([era.stroke for era in truth.eras])[:, None]
    values = (
        direct_acceleration(matrices, truth.eras, frequencies, POINTS, loads=truth.masses) / strokes
    )
    heard = noise_like(values, noise, rng)
    for name, scale in (scales or {}).items():
        values[:, :, NAMES.index(name)] *= scale
    return Measurement(sensors_at(POINTS, NAMES), frequencies, (values + heard).swapaxes(1, 2))


G = 9.80665  # m/s², standard gravity


def _exchanged(responses: Measurement, axis: int, first: int, second: int) -> Measurement:
    values = np.moveaxis(responses.values, axis, 0).copy()
    values[[first, second]] = values[[second, first]]
    return replace(responses, values=np.moveaxis(values, 0, axis))


def _times(factor: Callable[[np.ndarray], np.ndarray]) -> Callable[[Measurement], Measurement]:
    def change(responses: Measurement) -> Measurement:
        omega = 2 * np.pi * responses.frequencies[:, None, None]
        return replace(responses, values=responses.values * factor(omega))

    return change


DISTORTIONS: dict[str, Callable[[Measurement], Measurement]] = {
    "g": _times(lambda omega: 1 / G + 0 * omega),
    "velocity": _times(lambda omega: 1 / (1j * omega)),
    "displacement": _times(lambda omega: -1 / omega**2),
    "opposite": _times(lambda omega: -1 + 0 * omega),
    "conjugated": lambda responses: replace(responses, values=responses.values.conj()),
    "swapped_channels": lambda responses: _exchanged(responses, 2, 0, 1),
    "swapped_sensors": lambda responses: _exchanged(responses, 1, 0, 5),
    "two_sensors": lambda responses: responses.without(np.arange(len(responses.sensors)) > 1),
}
"""By name, what is done to the responses."""


def every(responses: Measurement, step: int, *, up_to: float) -> Measurement:
    """Every so many frequencies, up to one [Hz]."""
    rows = np.flatnonzero(responses.frequencies <= up_to)[::step]
    return replace(
        responses, frequencies=responses.frequencies[rows], values=responses.values[rows]
    )


Motion = Callable[[float], tuple[float, float]]
"""Displacement [m] and velocity [m/s] of a base at a time [s]."""


def lock_in(times: FloatArray, samples: FloatArray, frequency: float) -> ComplexArray:
    """Complex amplitudes (p,) A of Im[A exp(i w t)] in samples (n, p), by least squares."""
    w = 2 * np.pi * frequency
    basis = np.column_stack([np.sin(w * times), np.cos(w * times)])
    fit = np.linalg.lstsq(basis, samples, rcond=None)[0]
    return np.asarray(fit[0] + 1j * fit[1])


def apart(found: FloatArray, expected: FloatArray) -> float:
    """Relative L2 distance."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@dataclass(frozen=True)
class Base:
    """motion: displacement [m] and velocity [m/s] at a time [s]; terms: the same motion."""

    motion: Callable[[float], tuple[float, float]]
    terms: tuple[Term, ...]


def motion_of(motion: BaseMotionMotion, times: FloatArray) -> FloatArray:
    """Displacement [m] at times (n,) [s] by the definition of a term."""
    y = np.zeros(len(times))
    for term in motion:
        tau = times - term.start
        value = (term.c0 + term.c1 * tau) * np.exp(1j * term.omega * tau)
        y += np.where((times >= term.start) & (times < term.end), value.imag, 0.0)
    return y


STILL = Base(lambda time: (0.0, 0.0), ())


def faded_base(
    amplitude: float,
    frequency: float,
    phase: float,
    *,
    rise: tuple[float, float],
    fall: tuple[float, float],
) -> Base:
    """amplitude g(t) sin(2 pi frequency t + phase); g rises and falls along raised cosines.

    amplitude [m], frequency [Hz], phase [rad]; rise and fall: when each begins and ends [s].
    """
    omega = 2 * math.pi * frequency

    def motion(time: float) -> tuple[float, float]:
        (on, full), (off, silent) = rise, fall
        if not on <= time < silent:
            return 0.0, 0.0
        if time < full:
            turn = math.pi / (full - on)
            gain = (1 - math.cos(turn * (time - on))) / 2
            growth = turn * math.sin(turn * (time - on)) / 2
        elif time < off:
            gain, growth = 1.0, 0.0
        else:
            turn = math.pi / (silent - off)
            gain = (1 + math.cos(turn * (time - off))) / 2
            growth = -turn * math.sin(turn * (time - off)) / 2
        angle = omega * time + phase
        return (
            amplitude * gain * math.sin(angle),
            amplitude * (growth * math.sin(angle) + gain * omega * math.cos(angle)),
        )

    def at(time: float) -> complex:
        return cmath.rect(amplitude, omega * time + phase)

    up = raised_cosine(rise[0], rise[1] - rise[0], omega, 0j, at(rise[0]))
    up = (*up[:-1], up[-1]._replace(end=fall[0]))
    down = raised_cosine(fall[0], fall[1] - fall[0], omega, at(fall[0]), 0j)
    return Base(motion, (*up, *down))


def shaped_base(
    amplitude: float, frequency: float, *, start: float, step: float, knots: tuple[complex, ...]
) -> Base:
    """amplitude Im[a(t) exp(2 pi i frequency t)], a along straight lines through the knots.

    The first knot is at start [s], then one every step [s], then rest; amplitude [m].
    """
    omega = 2 * math.pi * frequency

    def motion(time: float) -> tuple[float, float]:
        steps = (time - start) / step
        before = math.floor(steps)
        if not 0 <= before < len(knots) - 1:
            return 0.0, 0.0
        slope = (knots[before + 1] - knots[before]) / step
        value = knots[before] + slope * (steps - before) * step
        turn = amplitude * cmath.exp(1j * omega * time)
        return (value * turn).imag, ((slope + 1j * omega * value) * turn).imag

    factor = amplitude * cmath.exp(1j * omega * start)
    return Base(motion, along_lines(start, step, omega, [factor * knot for knot in knots]))


STROKE = 1e-4  # m
BASES = (
    faded_base(STROKE, 110.0, 0.3, rise=(0.0, 0.02), fall=(0.07, 0.08)),
    STILL,
    faded_base(0.6 * STROKE, 250.0, -1.0, rise=(0.005, 0.015), fall=(0.08, 0.1)),
    shaped_base(STROKE, 110.0, start=0.0, step=0.005, knots=(0, 0.3, 0.5j, -0.8, 0.4 - 0.2j, 0)),
)
"""Ramps on two bases, an envelope on another, and one at rest."""

FINGERTIP = Fingertip(
    stiffness=1000.0,
    damping=2.0,
    contact_mass=0.0002,
    phalanx_mass=0.005,
    joint_stiffness=500.0,
    joint_damping=2.0,
)


def resting(
    *places: tuple[float, float], fingertip: Fingertip = FINGERTIP
) -> dict[str, FingertipLoad]:
    """Fingers at places [m], with ids a, b, ..."""
    return {
        chr(ord("a") + number): FingertipLoad(x, y, fingertip)
        for number, (x, y) in enumerate(places)
    }


def by_hand(forms: Forms, drive: WeightedTones) -> tuple[float, float]:
    """Robust score, and amplitude to threshold at the weakest target: powers of tones add."""
    target = np.zeros(len(forms.targets))
    quiet = np.zeros(forms.quiet.shape[1])
    for f, weights in drive:
        w = weights.astype(complex)
        threshold_power = float(forms.threshold[f]) ** 2
        for t, field in enumerate(forms.targets[:, f].astype(complex)):
            target[t] += abs(field @ w) ** 2 / threshold_power
        for q, form in enumerate(forms.quiet[f].astype(complex)):
            quiet[q] += (w.conj() @ form @ w).real / threshold_power
    return float(np.sqrt(target.min() / quiet.max())), float(np.sqrt(target.min()))


@dataclass(frozen=True)
class Realised:
    """Levels [dB SL] of fingers as asked, on d plates: of their own content and of all else.

    own (fingers, d): means over fingertips, NaN without a content; foreign (fingers, d): at the
    loudest points.
    """

    own: FloatArray
    foreign: FloatArray

    @property
    def contrast(self) -> FloatArray:
        """Contrast (fingers, d) [dB]: at quiet fingers that of the weakest content."""
        weakest = np.nanmin(self.own, axis=0)
        return np.where(np.isnan(self.own), weakest, self.own) - self.foreign


def realised(
    table: LocalizationTable,
    found: Answer,
    plates: Plates,
    *,
    threshold: str | None = None,
    resting: Sequence[Point] = (),
    loads: Sequence[float] = (),
    late: FloatArray | None = None,
) -> Realised:
    """Solve an answer on plates, drawn for as many contacts as it has.

    threshold: another set than the table's; resting: places of what lies in the stead of quiet
    fingers, with a load for each contact; late (d, eras): delays of the drives [s].
    """
    layers = [each.layer for each in found.fingers]
    places = [each.at for each in found.asked]
    if resting:
        places = [at for at, layer in zip(places, layers, strict=True) if layer is not None]
        layers = [*range(len(places)), *[None] * len(resting)]
    placed = Placement((*places, *resting), (), tuple(loads))
    weights = read_fingertips(table, placed.contacts).fine_weights

    def sensed(tones: Excitation) -> FloatArray:
        """Power to threshold at all fine points of the fingers, (fingers, points, d)."""
        frequency = next(iter(tones.values())).frequency
        drives = plates
        if late is not None:
            drives = replace(plates, gain=plates.gain * np.exp(-2j * np.pi * frequency * late))
        rows, power = powers_on(table, placed, tones, drives)
        hertz, name = table.frequencies[rows], threshold or table.threshold
        felt = (power / detection_threshold(hertz, name)[:, None, None] ** 2).sum(axis=0)
        own, other = (detection_threshold(2 * hertz[0], each) for each in (table.threshold, name))
        felt += (own / other) ** 2 * harmonics_on(table, placed, tones, drives)
        return felt.reshape(*weights.shape, -1)

    power = np.array([sum(map(sensed, (one.excitation, *one.side_bands))) for one in found.layers])
    levels, foreign = [], []
    for finger, layer in enumerate(layers):
        mine = np.arange(len(power)) == layer
        levels.append(weights[finger] @ np.sqrt(power[mine, finger].sum(axis=0)))
        foreign.append(power[~mine, finger].sum(axis=0).max(axis=0))
    own = np.where(np.equal(layers, None)[:, None], np.nan, levels)
    return Realised(20 * np.log10(own), 10 * np.log10(np.maximum(foreign, 1e-12)))
