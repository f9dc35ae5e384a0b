"""The localization table: its fields, frequencies, raster, and the table that follows a plate."""

import math
from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest

from kit.direct_plate import direct_acceleration
from kit.plates import contact_sets, make_paper_rig, smooth_rig, smooth_table
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.arrays import ComplexArray, FloatArray
from model.errors import InputError
from model.fem import assemble
from model.finger import Grid, detection_threshold, fingertip_points, fingertip_weights
from model.rig.rig import Rig
from model.structure.fingertips import FingertipLoad
from model.structure.material import Material
from model.structure.plate import Plate
from model.study.exact_plates import draw_plates, felt_on
from model.switched_patterns import highest_levels
from model.table.fingertip_shapes import read_fingertips
from model.table.raster import Raster
from model.table.table import LocalizationTable, default_drive_frequencies
from model.table.table_file import TableProblem, build_table
from model.vibration import Tone, tone_fields
from registry.limits import GuardLimits


def test_highest_level_is_that_of_the_best_pattern() -> None:
    """Eq. 28 written out: amplitudes add at one frequency, powers of two do."""
    rng = np.random.default_rng(0)
    parts = rng.normal(size=(2, 4, 5, 3))
    fields = np.asarray(parts[0] + 1j * parts[1], dtype=np.complex64)

    levels = highest_levels(fields[:, None])

    for position, field in enumerate(fields):
        sensations = np.abs(field).ravel().tolist()  # of one ERA
        for first, second in combinations(range(3), 2):
            sensations += np.abs(field[:, first] + field[:, second]).tolist()
            two_tones = np.hypot.outer(np.abs(field[:, first]), np.abs(field[:, second]))
            np.fill_diagonal(two_tones, 0)  # one frequency
            sensations += two_tones.ravel().tolist()
        assert levels[position] == pytest.approx(max(sensations), rel=1e-5), position


@pytest.mark.parametrize("mode", ["switched", "phased"])
def test_query_predicts_the_direct_solution(mode: str) -> None:
    """Level, contrast and the loudest quiet level, by the sparse direct solve with fingers on."""
    rig = smooth_rig()
    (places,) = contact_sets(1, fingers=4, seed=2)
    target, *quiet = places

    answer = query(smooth_table(), Placement((target,), tuple(quiet)), 17.0, drive_mode=mode)

    points = np.concatenate([fingertip_points(*place, rig.plate) for place in places])
    fingers = [FingertipLoad(*place, rig.fingertip) for place in places]
    matrices = assemble(rig.plate, rig.mesh)

    def direct_response(frequencies: FloatArray) -> ComplexArray:
        return direct_acceleration(matrices, rig.eras, frequencies, points, loads=fingers)

    frequencies, fields = tone_fields(answer.layers[0].excitation, rig.eras, direct_response)
    tones = np.abs(fields).T / detection_threshold(frequencies)
    sensed = np.linalg.norm(tones, axis=1)
    weights = fingertip_weights(*target, rig.plate)
    level = 20 * np.log10(sensed[: len(weights)] @ weights)
    sensation = answer.fingers[0]
    assert sensation.level_db_sl == pytest.approx(level, abs=0.03)
    assert sensation.promised_level_db_sl == pytest.approx(17.0)
    quiet_level = sensation.level_db_sl - sensation.contrast_db
    loudest = 20 * np.log10(sensed[len(weights) :].max())
    assert quiet_level == pytest.approx(loudest, abs=0.1)


def test_reachable_level_is_that_of_the_best_phases() -> None:
    """Four ERAs at full amplitude, by the sparse direct solve and a search in steps of 45°."""
    rig, table = smooth_rig(), smooth_table()
    points = np.array([[0.08, 0.06], [0.21, 0.17]])
    row = 7
    frequency = table.frequencies[row]
    matrices = assemble(rig.plate, rig.mesh)

    def direct_response(frequencies: FloatArray) -> ComplexArray:
        return direct_acceleration(matrices, rig.eras, frequencies, points)

    alone = []
    for era in rig.eras:
        _, fields = tone_fields({era.name: Tone(frequency, era.stroke)}, rig.eras, direct_response)
        alone.append(fields[0])
    turns = np.exp(1j * np.pi / 4 * np.arange(8))
    highest = np.zeros(2)
    for phases in product(turns, repeat=len(alone)):
        highest = np.maximum(highest, np.abs(np.dot(phases, alone)))
    found = 20 * np.log10(highest / detection_threshold(np.array([frequency])))
    reachable = table.reachable_db_sl(points)[row]
    # Phases that are up to 22.5° off give up to 0.7 dB less.
    assert (found - 0.03 < reachable).all()
    assert (reachable < found + 0.7).all()


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (20.0, 700.0, range(40, 501, 10)),
        (60.0, 300.0, range(60, 301, 10)),
        (75.0, 85.0, [80]),
        (61.0, 69.0, [61]),
    ],
)
def test_default_drive_frequencies_are_within_the_limits(
    low: float, high: float, expected: list[int]
) -> None:
    """40 to 500 Hz in steps of 10 within the limits; at least one."""
    limits = GuardLimits(frequency_min=low, frequency_max=high, level=1.0)

    np.testing.assert_array_equal(default_drive_frequencies(limits), list(expected))


@pytest.mark.parametrize(
    "frequencies", [[], [100, 100], [200, 100], [10], [100, 900], [100, math.nan]], ids=str
)
def test_table_needs_ascending_frequencies_within_the_limits(frequencies: list[float]) -> None:
    """At least one."""
    with pytest.raises(InputError, match="frequencies"):
        TableProblem(make_paper_rig(12, 9), np.array(frequencies, dtype=float), Grid(4, 3))


def test_table_that_needs_too_much_memory_is_refused() -> None:
    """A foil of 9 m² has some ten thousand modes, and is refused before it is solved."""
    rig = make_paper_rig(48, 36)
    foil = replace(rig.plate, length=3.0, width=3.0, thickness=0.0001)

    with pytest.raises(InputError, match="GB"):
        TableProblem(replace(rig, plate=foil), np.array([100.0, 500.0]), Grid(4, 3))


FIVE_OF_FINE = [0, 9, 12, 15, 18]
"""The rows of the five points among the fine points of a fingertip."""


@pytest.mark.usefixtures("kernels_or_numpy")
def test_read_fingertips_reads_the_points_and_weights_of_the_disc() -> None:
    """Reading x and y themselves returns the points, also where edges cut a fingertip."""
    table = smooth_table()
    plate = table.plate
    table = replace(table, shapes=table.raster.points.astype(np.float32))
    places = [(0.15, 0.11), (0.0, 0.0), (0.3048, 0.1), (0.2, 0.225), (0.006, 0.0031)]

    tips = read_fingertips(table, places)

    points = np.array([fingertip_points(x, y, plate) for x, y in places])
    weights = [fingertip_weights(x, y, plate) for x, y in places]
    np.testing.assert_allclose(tips.fine, points, atol=1e-6)
    np.testing.assert_allclose(tips.few, points[:, FIVE_OF_FINE], atol=1e-6)
    np.testing.assert_allclose(tips.fine_weights, weights, atol=1e-5)
    np.testing.assert_allclose(tips.few_weights[0], [0.5, *[0.125] * 4], atol=1e-6)


@pytest.mark.usefixtures("kernels_or_numpy")
def test_read_fingertips_reads_waves_at_the_edges() -> None:
    """Within 1e-4 on a raster at 3 mm; there the polynomials of twelve points are large."""
    plate = smooth_table().plate
    length, width = plate.length, plate.width
    raster = Raster(round(length / 0.003) + 1, round(width / 0.003) + 1, length, width)
    waves = np.array([[20.0, 9.0], [-13.0, 25.0], [5.0, 40.0]])  # rad/m
    shapes = np.cos(raster.points @ waves.T).astype(np.float32)
    table = replace(smooth_table(), raster=raster, shapes=shapes)
    steps = np.linspace(0.0, 0.006, 25)
    columns = [*steps, *(length - steps)]
    places = [*product(columns, (0.001, width / 2, width - 0.002))]

    tips = read_fingertips(table, places)

    points = np.array([fingertip_points(x, y, plate) for x, y in places])
    expected = np.cos(points @ waves.T)
    np.testing.assert_allclose(tips.fine, expected, atol=1e-4)
    np.testing.assert_allclose(tips.few, expected[:, FIVE_OF_FINE], atol=1e-4)


@pytest.mark.parametrize("thickness", [0.0001, 0.01])
def test_raster_fits_thin_and_small_plates(thickness: float) -> None:
    """A foil of short waves, and a plate barely larger than a fingertip."""
    plate = Plate(0.02, 0.03, thickness, Material("any", E=70e9, rho=2700.0, nu=0.33))
    raster = Raster.for_plate(plate, frequency_max=500.0)
    heights = (raster.points @ [[3], [-1]]).astype(np.float32)

    height = raster.interpolated(heights, np.array([[0.011, 0.004]]))

    np.testing.assert_allclose(height, [[0.029]], rtol=1e-5)


def test_raster_needs_six_points_on_each_side() -> None:
    """Five points carry no quintic."""
    with pytest.raises(InputError, match="6 to"):
        Raster(5, 9, 0.1, 0.1)


POINTS = np.array([[0.06, 0.05], [0.15, 0.11], [0.26, 0.17], [0.22, 0.04]])


@pytest.fixture(scope="module")
def table(rig: Rig) -> LocalizationTable:
    """Its table at a few frequencies."""
    frequencies = np.array([80.0, 145.0, 220.0, 310.0, 450.0])
    return build_table(rig, frequencies=frequencies, drive_mode="phased")


@pytest.mark.parametrize("frequency", [79.0, 115.0, 145.1, 451.0, math.nan])
def test_frequency_that_a_table_lacks_is_refused(
    table: LocalizationTable, frequency: float
) -> None:
    """Between two of its own and beyond them, for the table's plate and for drawn ones."""
    rng = np.random.default_rng(0)
    plates = draw_plates(rng, table.uncertainty, of=table, count=1, contact_count=1)
    tones = {"SW": Tone(frequency, 1e-6, 0.0)}

    with pytest.raises(InputError):
        table.amplitudes(tones, POINTS)
    with pytest.raises(InputError):
        felt_on(table, Placement(((0.08, 0.06),)), tones, plates)
