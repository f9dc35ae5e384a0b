"""Drawn plates with uncertain feet, harmonics and clock errors, by Monte Carlo and by hand.

Fields under loading fingertips, and with ERAs or exciters at other places, and their sensitivities:
by differences of the direct solve, and by rebuilt plates.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from kit.direct_plate import direct_acceleration
from kit.plates import LENGTH, WIDTH, contact_sets, smooth_rig
from model.answer.fingers_on_plate import FingersOnPlate
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import Complex64Array, ComplexArray, Float32Array, FloatArray
from model.ensemble.attached_plate import MODELED, PlateOnEras, attach, thickness_nodes
from model.ensemble.draws import (
    ClockErrors,
    Drawing,
    delayed,
    draw,
    percentile,
)
from model.ensemble.kernel_plates import touch
from model.ensemble.touched_plate import TouchedPlate
from model.errors import InputError
from model.fem import ELEMENTS, Mesh, assemble
from model.finger import FINE_POINTS, FINGERTIP_RADIUS, FIVE_POINTS, detection_threshold
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import Channel, Rig, Uncertainty
from model.structure.attachments import PointLoad, footprints_of
from model.structure.exciter import Exciter
from model.structure.fingertips import Fingertip, FingertipLoad
from model.table.table import LocalizationTable
from model.table.table_file import build_table

EXACT_DRIVES = {"gain": 0.0, "phase": 0.0, "common_gain": 0.0, "harmonic": 0.0, "thicknesses": 1}
PLACES = ((0.09, 0.07), (0.25, 0.18))


def test_common_gain_moves_all_channels_together() -> None:
    """Channels that are calibrated relative to each other are louder or softer by the same factor.

    By two standard deviations of 3 % on half of the plates each, independently of the rest. Of the
    plates within 1.28 of them, 90 % then keep 90 % of their levels.
    """
    deviations = {**EXACT_DRIVES, "common_gain": 0.03, "thicknesses": 40}

    plates = draw(4, 2, masses=0, count=200, seed=8, **deviations)

    factors = 1 + plates.gains[:4]
    same_for_all = np.broadcast_to(factors[0], factors.shape)
    np.testing.assert_allclose(factors, same_for_all, rtol=1e-6)
    np.testing.assert_allclose(factors.imag, 0, atol=1e-6)
    logarithms = np.log(factors[0].real)
    sizes, counts = np.unique(logarithms.round(5), return_counts=True)
    assert sizes == pytest.approx([-0.06, 0.06], rel=1e-3)
    assert counts.tolist() == [100, 100]


# Harmonics

LOADS = (1.0, 2.5)
FREQUENCIES = np.array([60.0, 145.0, 260.0, 430.0, 520.0])
SHARE = 0.02
WEIGHTS = np.array(
    [[1, 0.3j, -0.5, 0.2], [0.1, 1, 0.4j, 0], [-1, 0.2, 0.6, 1j], [1, 1, 0, 0], [1, 0, 0, 0]],
    dtype=np.complex64,
)
SEVERAL_THOUSAND = Drawing(count=4000, seed=3, thicknesses=1)


@cache
def table_with_harmonics() -> LocalizationTable:
    """Return the paper's plate on a mesh that carries 1 kHz; a drive is weaker above 60 Hz."""
    rig = smooth_rig()
    weaker = replace(rig.eras[0], gains=((60.0, 1.0, 0.3), (61.0, 0.5, 0.3)))
    rig = replace(
        rig,
        eras=(weaker, *rig.eras[1:]),
        mesh=Mesh(8, 6, rig.plate.length, rig.plate.width, ELEMENTS["Q5"]),
        limits=replace(rig.limits, frequency_max=520.0),
        uncertainty=replace(Uncertainty.none(), harmonic=SHARE),
    )
    return build_table(rig, frequencies=FREQUENCIES)


def solved_directly(
    table: LocalizationTable,
    frequency: float,
    points: FloatArray,
    fingers: Sequence[FingertipLoad] = (),
) -> FloatArray:
    """Return accelerations (eras, points) by each base that moves by its full stroke."""
    eras = [replace(era, gains=()) for era in table.eras]
    matrices = assemble(table.plate, table.mesh)
    (fields,) = direct_acceleration(matrices, eras, np.array([frequency]), points, loads=fingers)
    return np.asarray(fields)


@pytest.mark.parametrize("row", range(4))
def test_harmonics_at_fingers_are_those_of_drawn_phases(row: int) -> None:
    """Mean and percentiles of independent complex normal numbers of a share, by the direct solver.

    They are relative to each ERA's own motion, which for the first is smaller at twice the
    frequency.
    """
    table = table_with_harmonics()
    frequency = float(FREQUENCIES[row])
    fingers = FingersOnPlate.of(table, PLACES, LOADS)

    powers = fingers.harmonics(SEVERAL_THOUSAND, np.array([row]), WEIGHTS[[row]])[0]

    centers = np.array(PLACES)
    points = centers[:, None] + FINGERTIP_RADIUS * FIVE_POINTS.points
    fingertips = []
    for place, load in zip(PLACES, LOADS, strict=True):
        fingertips.append(FingertipLoad(*place, table.fingertip.scaled(load)))
    by_era = solved_directly(table, 2 * frequency, points.reshape(-1, 2), fingertips)
    motion = SHARE * np.abs(WEIGHTS[row])
    if frequency > 60:
        motion[0] /= 2
    rng = np.random.default_rng(1)
    normal = rng.standard_normal((20_000, 4, 2))
    phasors = normal @ [1, 1j] / np.sqrt(2)
    fields = (phasors * motion) @ by_era
    fields = fields.reshape(-1, 2, 5)
    threshold = detection_threshold(2 * frequency)
    means = np.abs(fields) ** 2 @ FIVE_POINTS.weights
    expected = means / threshold**2
    drawn = powers[:, 1:]
    assert powers[:, 0].tolist() == [0, 0]  # of the nominal plate
    np.testing.assert_allclose(drawn.mean(axis=1), expected.mean(axis=0), rtol=0.06)
    for percent in (50, 90):
        expected_percentile = np.percentile(expected, percent, axis=0)
        np.testing.assert_allclose(
            percentile(drawn, percent), expected_percentile, rtol=0.09, err_msg=f"{percent} %"
        )


# Clocks

IDENTIFIED = Uncertainty(0.015, 1.5, 0.002, 0.01, 1.1, 0.5, modulus=0.0, place=0.0, harmonic=0.0)
ERAS = tuple(era.name for era in smooth_rig().eras)
WIRING = {
    "SW": Channel("a", 0),
    "SE": Channel("b", 1),
    "NE": Channel("a", 2),
    "NW": Channel("b", 3),
}


@cache
def identified_table() -> LocalizationTable:
    """Return the paper's plate after an identification."""
    rig = replace(smooth_rig(), uncertainty=IDENTIFIED)
    return build_table(rig, frequencies=np.arange(40.0, 321.0, 10.0), drive_mode="phased")


def clocks(**errors: float) -> ClockErrors:
    """Return clocks of amplifiers a and b with these errors [s]."""
    return ClockErrors.of(ERAS, WIRING, errors)


TWO_CLOCKS = ClockErrors((0, 1), (20e-6, 20e-6))
"""Each ERA has an amplifier of its own."""


def test_difference_of_two_equal_drives_follows_from_their_delay() -> None:
    """2 sin(pi f t) for a delay t, at f = 250 Hz."""
    plates = draw(2, 1, masses=0, count=200, seed=8, **EXACT_DRIVES)
    omega = 2 * math.pi * np.array([1.0, 250.0])

    gains = delayed(plates.gains, TWO_CLOCKS, Drawing(200, 8, 1), omega)

    slow, fast = gains.astype(complex)
    delays = -np.angle(1 + slow[:2]) / omega[0]  # s, by the phase at 1 Hz
    np.testing.assert_allclose(delays.std(axis=1), 20e-6, rtol=0.01)
    half_phases = omega[1] * (delays[0] - delays[1]) / 2
    differences = np.abs(fast[0] - fast[1])
    np.testing.assert_allclose(differences, 2 * np.abs(np.sin(half_phases)), atol=2e-4)


def test_eras_of_one_amplifier_are_late_together() -> None:
    """Their factors are equal, and those of the other amplifier differ; a mass has no drive."""
    drawing = Drawing(64, 1, 1)
    exact = draw(4, 2, masses=1, count=64, seed=1, **EXACT_DRIVES).gains

    (gains,) = delayed(exact, clocks(a=1e-4, b=2e-4), drawing, np.array([200 * math.pi]))

    np.testing.assert_array_equal(gains[0], gains[2])
    np.testing.assert_array_equal(gains[1], gains[3])
    assert np.abs(gains[0] - gains[1]).min() > 0
    np.testing.assert_array_equal(gains[4:], 0)


def random_weights(rows: int) -> Complex64Array:
    """Return complex normal weights (rows, 4)."""
    rng = np.random.default_rng(0)
    real = rng.normal(size=(rows, 4))
    return (real + 1j * rng.normal(size=(rows, 4))).astype(np.complex64)


def quadratic_form(forms: Complex64Array, weights: Complex64Array) -> FloatArray:
    """Return w^H R w (f, q) of forms (f, q, n, n) and weights (f, n)."""
    return np.einsum("fi,fqij,fj->fq", weights.conj(), forms, weights).real


EXACTLY_KNOWN = Uncertainty.none()
OFF = replace(EXACTLY_KNOWN, touch_position=0.004)
"""Fingers 4 mm from where they are reported (root mean square), on a plate that is known."""


def table_touched(uncertainty: Uncertainty) -> LocalizationTable:
    """Return the identified table with another uncertainty, and fingers without a load."""
    table = identified_table()
    exact = np.zeros_like(table.discretization_error)
    return replace(table, uncertainty=uncertainty, discretization_error=exact, fingertip=None)


@pytest.mark.usefixtures("kernels_or_numpy")
def test_fingers_that_are_off_feel_the_field_where_they_are() -> None:
    """At each point of their discs: the field that the table has there, within 5 % of its change.

    One finger is cut by an edge, where only the slope of the field counts: within half.
    """
    table = table_touched(OFF)
    places = (*PLACES, (0.008, 0.12))
    drawing = Drawing(40, 5, 1)
    rows = np.array([3, 12, 25])
    weights = random_weights(3)
    fingers = FingersOnPlate.of(table, places, ())

    powers = fingers.powers(drawing, rows, weights)

    nominal = np.sqrt(powers[..., :1])
    touches = draw(4, 3, count=40, seed=5, **EXACT_DRIVES).touches
    per_axis = 0.004 / math.sqrt(2)
    sides = np.array([LENGTH, WIDTH])
    for finger, allowed in enumerate((0.05, 0.05, 0.5)):
        centers = np.array(places[finger]) + per_axis * touches[:, finger].T
        discs = centers[:, None] + FINGERTIP_RADIUS * FINE_POINTS.points
        is_on_plate = ((discs > 0) & (discs < sides)).all(axis=2).T
        fields = table.unit_fields(discs.reshape(-1, 2))[rows]
        amplitudes = np.abs(np.einsum("mn,mnp->mp", weights, fields)).reshape(3, 40, -1)
        expected = amplitudes.swapaxes(1, 2) / table.thresholds[rows, None, None]
        error = np.sqrt(powers[:, finger, :, 1:]) - expected
        change = expected - nominal[:, finger]
        assert rms_where(is_on_plate, error) < allowed * rms_where(is_on_plate, change)


def rms_where(is_counted: NDArray[np.bool_], values: FloatArray) -> float:
    """Return the root mean square of values (m, p, d) at some points and plates (p, d)."""
    return float(np.sqrt((values[:, is_counted] ** 2).mean()))


@pytest.mark.usefixtures("kernels_or_numpy")
def test_expected_power_counts_fingers_that_are_off() -> None:
    """w^H R w exceeds that of exact touches by the mean square change over 4000 plates.

    At the center of a fingertip, for weights without a field there.
    """
    table = table_touched(OFF)
    fingers = FingersOnPlate.of(table, PLACES, ())
    tips = fingers.tips
    rows = np.array([3, 12, 25])
    centers = fingers.touched.centers[:1]
    fields = fingers.touched.forms(rows, centers[None], np.ones((1, 1), np.float32), NO_ERROR)
    weights = orthogonal(random_weights(3), fields.fields[:, 0, 0])

    forms = [
        fingers.touched.forms(rows, tips.few, tips.few_weights, NO_ERROR, touch_steps=steps).power
        for steps in (None, tips.touch_steps)
    ]

    exact, off = (quadratic_form(power, weights)[:, 0] for power in forms)
    drawn = fingers.powers(Drawing(4000, 5, 1), rows, weights)[:, 0, 0, 1:]
    expected = drawn.mean(axis=-1) * table.thresholds[rows] ** 2
    np.testing.assert_allclose(off - exact, expected, rtol=0.1)


NO_ERROR = np.zeros((29, 4), np.float32)
"""Mean square errors of the fields of four ERAs at the frequencies of `identified_table`."""


def orthogonal(weights: Complex64Array, fields: Complex64Array) -> Complex64Array:
    """Return weights (m, n) without the part that is felt in fields (m, n) of ERAs."""
    felt = (weights * fields).sum(axis=1, keepdims=True)
    power = (np.abs(fields) ** 2).sum(axis=1, keepdims=True)
    return np.asarray(weights - felt / power * fields.conj())


@pytest.mark.usefixtures("kernels_or_numpy")
def test_amplifier_whose_clock_is_not_held_plays_its_own_contents() -> None:
    """Each content is played by one amplifier's ERAs."""
    table = identified_table().with_clocks(clocks(a=math.inf, b=math.inf))

    for places in contact_sets(8, fingers=2, seed=4):
        fingers = [Finger(place, Stimulus(14.0)) for place in places]
        served = answer(table, fingers, min_contrast_db=-math.inf)
        assert len(served.layers) == 2
        for layer in served.layers:
            assert len({WIRING[era].amplifier for era in layer.excitation}) == 1, places


@pytest.mark.parametrize(
    ("errors", "groups"),
    [((5e-6, math.inf, 5e-6), (0, 1, 0, 0)), ((1e-4,) * 3, ()), ((1e-3,) * 3, (0, 1, 2, 2))],
    ids=["two held", "all held", "none held"],
)
def test_amplifiers_that_are_held_play_together(
    errors: Sequence[float], groups: Sequence[int]
) -> None:
    """Of three amplifiers two are held: their ERAs are one group, and the third's another."""
    wiring = dict(WIRING, NE=Channel("c", 0), NW=Channel("c", 1))
    error_by_name = dict(zip("abc", errors, strict=True))

    clock_errors = ClockErrors.of(ERAS, wiring, error_by_name)

    assert clock_errors.groups == groups


@pytest.mark.parametrize("errors", [{}, {"b": math.nan}, {"b": -1e-6}], ids=str)
def test_clock_errors_are_needed_for_all_amplifiers(errors: dict[str, float]) -> None:
    """They must be numbers, 0 or more."""
    with pytest.raises(InputError, match="amplifier b"):
        clocks(a=1e-6, **errors)


# Touched plates

TOUCHES = np.array([[0.09, 0.07], [0.25, 0.18], [0.03, 0.19]])
POINTS = TOUCHES[:, None] + FINGERTIP_RADIUS * FIVE_POINTS.points
HERTZ = np.array([60.0, 145.0, 260.0, 430.0])
ROWS = np.arange(4)
HEAVY_MASS = PointLoad(0.2, 0.05, mass=0.03)
FOOT = PointLoad(0.02, 0.2, stiffness=30e3, damping=1.0, loss_factor=0.15, is_foot=True)
LIGHT_MASS = PointLoad(0.29, 0.12, mass=0.01)
RIG = replace(
    smooth_rig(),
    mesh=Mesh(4, 3, LENGTH, WIDTH, ELEMENTS["Q5"]),
    masses=(HEAVY_MASS, FOOT, LIGHT_MASS),
)


def with_unequal_eras() -> Rig:
    """Return the rig with ERAs that differ in stiffness, stroke and gain."""
    eras = []
    for number, era in enumerate(RIG.eras):
        unequal = replace(
            era,
            stiffness=era.stiffness * (0.8 + 0.15 * number),
            stroke=era.stroke * (1.2 - 0.1 * number),
            gains=((60.0, 0.9 + 0.1 * number, 0.02), (430.0, 1.0, -0.1 * number)),
        )
        eras.append(unequal)
    return replace(RIG, eras=tuple(eras))


UNEQUAL = with_unequal_eras()
EXCITER = Exciter(
    "SE",
    LENGTH,
    0.0,
    stiffness=4769.0,
    damping=0.83,
    magnet_mass=0.0335,
    coil_mass=1.29e-3,
    force_factor=1.54,
    resistance=3.6,
    voltage=20.0,
    inductance=7e-5,
    gains=((60.0, 0.9, 0.02), (430.0, 1.0, -0.4)),
)
MIXED = replace(RIG, eras=(RIG.eras[0], EXCITER, *RIG.eras[2:]))
"""With an exciter in place of an ERA, driven to as much at 60 Hz, its resonance."""

TOLERANCES = Uncertainty(0, 0, 0.02, 0.01, math.e, 1.0, supports=0.3)
DEVIATIONS = {"loss": 1.0, "damping": 1.0, "stiffness": 0.01, "load": 1.0, "foot": 0.3}
"""The same by name, relative: the unit of sensitivities."""


@dataclass(frozen=True)
class Touched:
    """A plate with fingers, reduced for them too, so that nothing is left out."""

    plate: TouchedPlate
    shapes: Float32Array
    """Shapes (fingers, 5, modes) at the points of the fingertips."""

    @classmethod
    def by(
        cls,
        uncertainty: Uncertainty,
        loads: tuple[float, ...] = (),
        *,
        rig: Rig = RIG,
        count: int = 3,
        modulus: float = 0.0,
    ) -> "Touched":
        """Put the first fingers on the plate of a rig, whose modulus has a tolerance."""
        fixed = footprints_of(rig.eras, rig.masses)
        fingers = np.column_stack([TOUCHES, np.zeros(3)])
        footprints = np.vstack([fixed, fingers])
        reduced = reduce_plate(rig.plate, rig.mesh, footprints, frequency_max=500.0)
        plate = attach(
            rig.plate,
            reduced.omega,
            reduced.losses,
            reduced.at(fixed),
            eras=rig.eras,
            masses=rig.masses,
            fingertip=rig.fingertip,
            uncertainty=replace(uncertainty, modulus=modulus),
            frequencies=HERTZ,
        )
        shapes = reduced.at(POINTS.reshape(-1, 2)).astype(np.float32)
        shapes = shapes.reshape(3, 5, -1)[:count]
        on_eras = PlateOnEras.of(plate, 2, 5)
        return cls(touch(on_eras, shapes[:, 0], loads), shapes)

    @property
    def points(self) -> Float32Array:
        """Shapes at all points of all fingertips in turn."""
        return self.shapes.reshape(-1, self.shapes.shape[-1])

    @property
    def weights(self) -> Float32Array:
        """Weights (fingers, 5) of the points of each fingertip."""
        weights = FIVE_POINTS.weights.astype(np.float32)
        return np.tile(weights, (len(self.shapes), 1))

    def forms(self) -> Any:
        """Return the fields and expected powers of the fingers, without errors."""
        no_error = np.zeros((4, 4), np.float32)
        return self.plate.forms(ROWS, self.shapes, self.weights, no_error)

    def changes(self, weights: Complex64Array, *, node: int = MODELED) -> dict[str, ComplexArray]:
        """Return the changes of the accelerations (f, points) by each parameter's deviation."""
        nodes = np.full(4, node)
        by_force, moved = self.plate.sources(ROWS, nodes, self.points)
        motion = np.einsum("fan,fn->fa", moved, weights)
        changes = self.plate.changes(ROWS, nodes, weights, motion, self.points)
        by_own = by_force * changes.own[:, None, :]
        return {
            "loss": np.matvec(by_force, changes.loss) + changes.by_loss,
            "damping": np.matvec(by_force, changes.damping),
            "stiffness": by_own[:, :, 1],
            "foot": by_own[:, :, 5],  # after four ERAs and a mass
            "load": by_own[:, :, 8],  # of the second finger
        }

    def drawn(self, plate: TouchedPlate, weights: Complex64Array, **drawing: Any) -> Any:
        """Return the powers and means that drawn plates feel, with errors if they are few."""
        error = np.zeros((4, 4), np.float32)
        if drawing["count"] < 100:
            error[1:3] = [[1e-4], [1e-2]]
        thresholds = np.ones(4, dtype=np.float32)
        return plate.drawn(
            Drawing(**drawing),
            ROWS,
            weights,
            self.points,
            self.weights,
            error,
            thresholds,
            with_powers=True,
        )


@dataclass(frozen=True)
class Variation:
    """Factors by which a plate differs."""

    thickness: float = 1.0
    modulus: float = 1.0
    loss: float = 1.0
    damping: float = 1.0
    stiffness: float = 1.0
    """Of the second ERA."""
    load: float = 1.0
    """On all of the second finger."""
    foot: float = 1.0
    pressed: tuple[float, ...] = (1, 1, 1)
    """On pulp and contact mass of each finger."""

    def fingers(self, fingertip: Fingertip) -> list[FingertipLoad]:
        """Return all fingers on the plate."""
        loads = []
        for touch_place, factor in zip(TOUCHES, self.pressed, strict=True):
            loads.append(FingertipLoad(*touch_place, fingertip.scaled(factor)))
        second = loads[1].fingertip.multiplied(self.load)
        loads[1] = replace(loads[1], fingertip=second)
        return loads


@cache
def direct_fields(variation: Variation, *, with_exciter: bool = False) -> ComplexArray:
    """Return direct fields (f, eras, points) of a plate that differs."""
    rig = MIXED if with_exciter else RIG
    plate = replace(
        rig.plate.scaled(modulus=variation.modulus),
        thickness=variation.thickness * rig.plate.thickness,
        loss_factor=variation.loss * rig.plate.loss_factor,
    )
    eras = [era.varied(damping=variation.damping) for era in rig.eras]
    eras[1] = eras[1].varied(stiffness=variation.stiffness)
    foot = replace(FOOT, stiffness=variation.foot * FOOT.stiffness)
    loads = [HEAVY_MASS, foot, LIGHT_MASS, *variation.fingers(rig.fingertip)]
    matrices = assemble(plate, rig.mesh)
    return direct_acceleration(matrices, eras, HERTZ, POINTS.reshape(-1, 2), loads=loads)


def largest_error(fields: ComplexArray, exact: ComplexArray) -> float:
    """Return the largest error of all frequencies, relative to the largest value at each."""
    axes = tuple(range(1, exact.ndim))
    errors = np.abs(fields - exact).max(axis=axes)
    sizes = np.abs(exact).max(axis=axes)
    return float((errors / sizes).max())


@pytest.mark.usefixtures("kernels_or_numpy")
@pytest.mark.parametrize(
    ("rig", "pressed"),
    [(RIG, (1, 1, 1)), (RIG, (0.4, 1.0, 2.5)), (MIXED, (1, 1, 1))],
    ids=["like", "", "exciter"],
)
def test_fields_are_those_of_the_direct_solve(rig: Rig, pressed: tuple[float, ...]) -> None:
    """At every finger's points, with an ERA's drive and a mass on the plate: to 2e-4.

    Whether all fingers press alike or not.
    """
    touched = Touched.by(Uncertainty(), pressed, rig=rig)

    fields = touched.forms().fields
    by_era = fields.transpose(0, 3, 1, 2).reshape(4, 4, 15)

    exact = direct_fields(Variation(pressed=pressed), with_exciter=rig is MIXED)
    assert largest_error(by_era, exact) < 2e-4


DRIVE = np.array([0.6, -0.3 + 0.5j, 1.0, 0.2j], dtype=np.complex64)


def test_sensitivity_to_the_load_of_a_finger_that_presses_harder() -> None:
    """A finger pressed 2.5 times as much between others, by a difference of the direct solve."""
    pressed = (0.4, 2.5, 1.0)
    touched = Touched.by(Uncertainty(0, 0, 1.0, 1.0, math.e, 1.0), pressed)

    change = touched.changes(np.ones((4, 4), dtype=np.complex64))["load"]

    high = direct_fields(Variation(pressed=pressed, load=1.001))
    low = direct_fields(Variation(pressed=pressed, load=0.999))
    exact = (high - low).sum(axis=1) / 2e-3
    assert largest_error(change, exact) < 0.01


@pytest.mark.parametrize("rig", [RIG, MIXED], ids=["", "exciter"])
@pytest.mark.parametrize("name", DEVIATIONS)
def test_sensitivities_of_a_thicker_plate_are_differences_of_the_direct_solve(
    name: str, rig: Rig
) -> None:
    """For a plate 3 % thicker, by central differences: within 1 % of the largest change."""
    touched = Touched.by(TOLERANCES, rig=rig)
    node = touched.plate.plate_on_eras.first[5] + 4

    change = touched.changes(np.tile(DRIVE, (4, 1)), node=node)[name]

    deviation = float(thickness_nodes(5)[4])
    thicker = Variation(thickness=1 + 0.02 * deviation)
    step = 1e-3 * DEVIATIONS[name]
    higher = replace(thicker, **{name: 1 + step})
    lower = replace(thicker, **{name: 1 - step})
    high = direct_fields(higher, with_exciter=rig is MIXED)
    low = direct_fields(lower, with_exciter=rig is MIXED)
    exact = np.einsum("e,fep->fp", DRIVE, high - low) / 2e-3
    assert largest_error(change, exact) < 0.01


@pytest.mark.usefixtures("kernels_or_numpy")
def test_expected_power_is_the_mean_square_of_the_draws() -> None:
    """w^H R w of random weights is the mean over 4000 drawn plates, without the loss factor.

    The thickness deviates so little that changes are proportional to it.
    """
    tolerances = replace(Uncertainty(), thickness=0.002, damping=1.0, supports=0.3)
    touched = Touched.by(tolerances)
    weights = random_weights(4)

    powers = touched.drawn(touched.plate, weights, count=4000, seed=5, thicknesses=2).powers

    means = powers[:, :, 1:].mean(axis=2).reshape(4, 3, 5)
    expected = quadratic_form(touched.forms().power, weights)
    np.testing.assert_allclose(expected, means @ FIVE_POINTS.weights, rtol=0.05)


def assert_same_arrays(record: Any, exact: Any) -> None:
    """Compare all arrays of two records, to 1e-4 of the largest value."""
    for name, values in vars(exact).items():
        largest = float(np.abs(values).max())
        np.testing.assert_allclose(
            getattr(record, name), values, rtol=1e-4, atol=1e-4 * largest, err_msg=name
        )


@pytest.mark.parametrize(
    ("rig", "count"),
    [(UNEQUAL, 1), (UNEQUAL, 3), (MIXED, 3)],
    ids=["1", "3", "exciter-3"],
)
@pytest.mark.usefixtures("kernels_or_numpy")
def test_every_stage_is_that_of_numpy(rig: Rig, count: int) -> None:
    """Fields, forms and the powers of drawn plates, in single precision: to 1e-4 of the largest.

    ERAs differ in stiffness, stroke and gain, so that none takes the place of another.
    """
    loads = (0.4, 12.0, 2.5)[:count]  # a finger, a hand, a finger
    touched = Touched.by(replace(Uncertainty(), supports=0.3), loads, rig=rig, count=count)
    plate = touched.plate
    by_numpy = TouchedPlate(plate.plate_on_eras, plate.centers, plate.stiffness, plate.load_std)
    error = np.full((4, 4), 0.01, np.float32)

    # each finger by itself
    rows = np.array([2, 0, 3])
    shapes = touched.shapes
    arguments = (rows, shapes, touched.weights, error, shapes[:, 1:3])
    assert_same_arrays(plate.forms(*arguments), by_numpy.forms(*arguments))

    # all fingers in one group, at their centers, whose fields are computed already
    thirds = np.full((1, count), 1 / count, np.float32)
    arguments = (ROWS, plate.centers[None], thirds, error, shapes[:1, 1:3])
    assert_same_arrays(plate.forms(*arguments), by_numpy.forms(*arguments))

    weights = np.tile(DRIVE, (4, 1))
    for bases in (1, 5):
        drawing = {"count": 45, "seed": 1, "thicknesses": 5, "bases": bases}
        felt = touched.drawn(plate, weights, **drawing)
        assert_same_arrays(felt, touched.drawn(by_numpy, weights, **drawing))
        assert felt.means.std(axis=2).min() > 0


# Places of ERAs

SHIFTED_PLACES = ((0.05, 0.04), (0.26, 0.06), (0.24, 0.19), (0.13, 0.12))
STEP = 1e-4  # m


@pytest.mark.long
def test_places_that_are_off_change_fields_as_much_as_stiffnesses_do() -> None:
    """All fields over the plate, mean square: an ERA off by 1 mm along x and y, and its spring."""
    corners = smooth_rig()
    eras = []
    for era, (x, y) in zip(corners.eras, SHIFTED_PLACES, strict=True):
        eras.append(replace(era, x=x, y=y))
    tolerances = replace(Uncertainty.none(), stiffness=0.01, place=0.001)
    rig = replace(corners, eras=tuple(eras), uncertainty=tolerances)
    table = build_table(rig, frequencies=HERTZ[:3])
    matrices = assemble(rig.plate, rig.mesh)

    def squared_slope(number: int, name: str, step: float) -> FloatArray:
        """Return the squared derivative (f,) of all fields to a field of an ERA."""
        fields = []
        for sign in (1, -1):
            changed = list(eras)
            value = getattr(eras[number], name) + sign * step
            changed[number] = replace(eras[number], **{name: value})
            solved = direct_acceleration(matrices, changed, HERTZ[:3], table.raster.points)
            fields.append(solved)
        slopes = (fields[0] - fields[1]) / (2 * step)
        squares = np.abs(slopes) ** 2
        return np.asarray(squares.sum(axis=(1, 2)))

    for number, era in enumerate(eras):
        by_place = squared_slope(number, "x", STEP)
        by_place += squared_slope(number, "y", STEP)
        by_spring = squared_slope(number, "stiffness", 1e-3 * era.stiffness)
        tolerance = 0.01 * era.stiffness
        ratio = np.sqrt(by_place / by_spring)
        expected = np.hypot(tolerance, 0.001 * ratio)
        stiffness = table.on_eras.plate.by_stiffness[:, number].real
        np.testing.assert_allclose(stiffness, expected, rtol=0.03, err_msg=era.name)
