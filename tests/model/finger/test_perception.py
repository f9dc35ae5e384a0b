"""Thresholds, levels, the band that is felt, and the grid of fingers."""

import numpy as np
import pytest

from model.errors import InputError
from model.finger import (
    THRESHOLDS,
    Grid,
    check_has_threshold,
    detection_threshold,
    felt_part,
    highest_measured,
    sensation_level,
    sensitivities,
)
from model.structure.plate import Material, Plate

PROBE, PRESSING = "vibrotactile-probe", "pressing-fingertip"


def test_detection_threshold_equals_table():
    """At 250 Hz a fingertip detects 0.1 um, 0.247 m/s² (Verrillo 1963 and followers)."""
    displacement = detection_threshold(np.array([250.0])) / (2 * np.pi * 250.0) ** 2
    assert displacement[0] == pytest.approx(0.100e-6, rel=0.01)


def test_sensation_level_adds_tones_as_powers():
    """Two tones each at threshold are together 3 dB above it."""
    frequencies = np.array([100.0, 250.0])
    level = sensation_level(frequencies, detection_threshold(frequencies))
    assert level == pytest.approx(10 * np.log10(2))


def test_sensation_level_of_zero_is_minus_infinity():
    """Where nothing moves the level is minus infinity, not an error."""
    assert sensation_level(np.array([100.0]), np.array([0.0])) == -np.inf


def test_thresholds_of_pressing_fingertips_lie_20_to_35_db_lower_around_250_hz():
    """Where Pacinian corpuscles decide, from 100 to 400 Hz; at 20 Hz they lie within 5 dB."""
    frequencies = np.array([100.0, 160.0, 250.0, 400.0])
    lower = 20 * np.log10(
        detection_threshold(frequencies, PROBE) / detection_threshold(frequencies, PRESSING)
    )
    assert ((lower >= 20) & (lower <= 35)).all()
    low = np.array([20.0])
    ratio = detection_threshold(low, PROBE) / detection_threshold(low, PRESSING)
    assert abs(20 * np.log10(ratio[0])) < 5


def test_gripping_hand_thresholds_are_peak_values_of_the_published_rms():
    """0.065 m/s² rms at 40 Hz (Morioka and Griffin 2006) is 0.0919 m/s² peak."""
    found = detection_threshold(np.array([40.0]), PRESSING)
    assert found[0] == pytest.approx(0.065 * np.sqrt(2), rel=1e-3)


@pytest.mark.parametrize("name", THRESHOLDS)
def test_every_set_reaches_1000_hz_and_has_matching_columns(name, pytestconfig):
    """Displacement times omega squared is acceleration, in every row to the digits printed."""
    text = (pytestconfig.rootpath / f"model/data/thresholds/{name}.csv").read_text("utf-8")
    rows = [line.split(",") for line in text.splitlines() if line[0].isdigit()]
    for frequency, displacement, acceleration, _ in rows:
        expected = float(displacement) * 1e-6 * (2 * np.pi * float(frequency)) ** 2
        assert float(acceleration) == pytest.approx(expected, rel=0.01)
    assert float(rows[0][0]) == 10
    assert float(rows[-1][0]) == 1000


@pytest.mark.parametrize("frequency", [9.9, 1000.1, np.nan])
def test_frequencies_without_data_are_refused(frequency):
    """Neither a threshold nor a level nor a margin is made up outside of a set."""
    asked = np.array([100.0, frequency])
    for refused in (
        lambda: check_has_threshold(asked),
        lambda: detection_threshold(asked, PRESSING),
        lambda: sensation_level(asked, np.ones(2)),
        lambda: sensitivities(asked, THRESHOLDS),
    ):
        with pytest.raises(InputError, match="10 to 1000 Hz"):
            refused()


def test_a_set_that_is_not_known_is_refused():
    """The error names the sets."""
    with pytest.raises(InputError, match=PRESSING):
        detection_threshold(np.array([100.0]), "thumb")


def test_sensitivities_are_ratios_of_thresholds():
    """At 250 Hz the probe's thresholds are 0.247 m/s² and those of pressing fingers 28 dB lower."""
    found = sensitivities(np.array([40.0, 250.0]), (PROBE, PRESSING), PROBE)
    assert found[0] == pytest.approx(1)
    assert found[1] == pytest.approx([0.251 / 0.0919, 0.247 / 0.0098], rel=0.02)


def test_measured_thresholds_end():
    """The probe's thresholds end at 500 Hz, those of pressing fingertips at 315 Hz."""
    assert [highest_measured(name) for name in (PROBE, PRESSING)] == [500.0, 315.0]


@pytest.mark.parametrize("rate", [8000.0, 10_000.0, 44_100.0])
@pytest.mark.parametrize(
    ("frequency", "passes"), [(40, 1), (300, 1), (850, 1), (1800, 0), (2500, 0), (3900, 0)]
)
def test_felt_part_passes_tones_up_to_a_kilohertz(
    rate: float, frequency: float, passes: float
) -> None:
    """Within 1 %, in phase and sample by sample; what is far above is gone."""
    times = np.arange(round(0.1 * rate)) / rate
    tone = np.sin(2 * np.pi * frequency * times + 0.7)
    found = felt_part(np.column_stack([tone, -2 * tone]), rate)
    inner = (times > 0.003) & (times < 0.097)
    np.testing.assert_allclose(found[inner, 0], passes * tone[inner], atol=0.01)
    np.testing.assert_allclose(found[:, 1], -2 * found[:, 0], atol=1e-12)


def test_felt_part_of_slow_samples_is_all_of_them() -> None:
    """At 2 kHz nothing above 1 kHz is in them; none at all are none."""
    samples = np.random.default_rng(0).normal(size=(50, 2))
    np.testing.assert_array_equal(felt_part(samples, 2000.0), samples)
    assert felt_part(np.zeros((0, 3)), 10_000.0).shape == (0, 3)


PLATE = Plate(0.6, 0.2, 0.002, Material("steel", 210e9, 7850.0, 0.3))


def test_grid_numbers_cells_along_x_first():
    """Three by two cells of 200 x 100 mm."""
    centres = [[x, y] for y in (0.05, 0.15) for x in (0.1, 0.3, 0.5)]
    np.testing.assert_allclose(Grid(3, 2).centres(PLATE), centres)
