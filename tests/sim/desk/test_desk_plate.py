"""The plate on a desk against a direct solution, and identified behind its sound card."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.desk_plate.desk_plate import DeskPlate
from benchmarks.desk_plate.lifted_blocks import sampled
from benchmarks.desk_plate.model_in_time import DeskModel
from benchmarks.desk_plate.sensing import Converters
from benchmarks.desk_plate.truth import Truth
from benchmarks.direct_plate import direct_responder
from drivers.errors import LinkError
from era_haptics.lab.measuring.measure import measure_through
from era_haptics.lab.measuring.sound_card import Desk, Multisine
from model.arrays import ComplexArray, FloatArray
from model.calibration.responses import WiredSensor, read_sensors
from model.errors import InputError
from model.finger import fingertips_on
from model.identification.identify import identify
from model.identification.least_squares import MeasuredPlate
from model.rig.rig import Rig
from model.structure.attachments import fingertip_loads
from sound_cards import DeskCard

RATE = 48_000.0
POINTS = np.array([[0.03, 0.05], [0.20, 0.11], [0.29, 0.20]])
FREQUENCIES = np.array([61.0, 150.0, 233.0, 410.0])
FINGERS = [(0.1, 0.1), (0.25, 0.06)]


@pytest.fixture(scope="module")
def model(truth: Truth) -> DeskModel:
    """That plate, solved."""
    return DeskModel(truth, POINTS)


@pytest.mark.parametrize("places", [[], FINGERS])
def test_model_agrees_with_the_direct_solution(
    truth: Truth, model: DeskModel, places: list[tuple[float, float]]
) -> None:
    """Without and with fingers; what differs is damping, viscous here and hysteretic there."""
    rig = truth.rig
    fingers = fingertip_loads(rig.fingertip, places)
    found = model.under(fingers).response(FREQUENCIES).swapaxes(1, 2)
    direct = direct_responder(rig.plate, rig.mesh)
    exact = direct(rig.eras, FREQUENCIES, POINTS, loads=[*rig.masses, *fingers])
    # The actuator by its differential equation: gain w² / (w² - omega² + 2 i zeta w omega).
    for number, actuator in enumerate(truth.actuators):
        w, omega = 2 * np.pi * actuator.resonance, 2 * np.pi * FREQUENCIES
        moved = actuator.gain * w**2 / (w**2 - omega**2 + 2j * actuator.ratio * w * omega)
        exact[:, number] *= moved[:, None]
    wrong = np.linalg.norm(found - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
    assert wrong.max() < 0.005


def test_fingers_feel_the_plate_under_them(truth: Truth) -> None:
    """At all points of fingertips whose loads differ, as the direct solution of the loaded plate.

    What differs is damping, viscous here and hysteretic there.
    """
    rig, factors, frequency = truth.rig, [0.3, 3.0], 150.0
    sensors = [WiredSensor("P1", 0.03, 0.05, 1, 1e-3)]
    desk = DeskPlate(truth, sensors, rate=RATE, converters=Converters(), seed=1)
    desk.set_fingers(FINGERS, factors)
    played = np.zeros((48_000, 5))
    played[:, 1] = np.sin(2 * np.pi * frequency * np.arange(len(played)) / RATE)
    desk.advance(played[:38_400])
    desk.begin_feeling()
    desk.advance(played[38_400:])
    felt = desk.felt()
    points, _ = fingertips_on(np.array(FINGERS), length=rig.plate.length, width=rig.plate.width)
    assert felt.shape == (600, *points.shape[:2])
    loads = [
        replace(each, fingertip=each.fingertip.multiplied(factor))
        for each, factor in zip(fingertip_loads(rig.fingertip, FINGERS), factors, strict=True)
    ]
    direct = direct_responder(rig.plate, rig.mesh)
    places, hertz = points.reshape(-1, 2), np.array([frequency])
    exact = direct(rig.eras, hertz, places, loads=[*rig.masses, *loads])[0, 1]
    exact = exact * truth.actuators[1].response(hertz)
    times = (38_400 + 16 * np.arange(len(felt))) / RATE
    found = phasors(felt.reshape(len(felt), -1), times, frequency)
    assert np.linalg.norm(found - exact) < 0.01 * np.linalg.norm(exact)


def test_fingers_are_swapped_without_a_jump(truth: Truth, model: DeskModel) -> None:
    """The vibration goes on where it was, and settles to that of the plate under fingers."""
    sensors = [WiredSensor(f"P{n}", x, y, n + 1, 1e-3) for n, (x, y) in enumerate(POINTS)]
    quiet = Converters(delay=0, noise=0.0)
    desk = DeskPlate(truth, sensors, rate=RATE, converters=quiet, seed=1)
    times = np.arange(48_000) / RATE
    played = np.zeros((len(times), 5))
    played[:, 0] = np.sin(2 * np.pi * 233 * times)
    before = desk.advance(played[:9600])
    desk.set_fingers(FINGERS)
    after = desk.advance(played[9600:])
    joined = np.concatenate([before[-48:], after[:48]])[:, :3]
    steps = np.abs(np.diff(joined, n=2, axis=0)).max(axis=1)
    # A contact mass that joins changes accelerations by a few percent, no more.
    assert steps[46:49].max() < 0.1 * np.abs(joined).max()
    loaded = model.under(fingertip_loads(truth.rig.fingertip, FINGERS))
    (exact,) = sampled(loaded, rate=RATE).response(np.array([233.0]))
    found = phasors(after[-9600:, :3], times[-9600:], 233.0)
    late = quiet.response(np.array([233.0]), rate=RATE)[0]
    np.testing.assert_allclose(found / (1e-3 * late), exact[:, 0], rtol=0.01)


def test_sensitivity_is_in_full_scale(rig: Rig, tmp_path: Path) -> None:
    """A charge of 5 pC/(m/s²), amplified by 2 mV/pC, at 4 V full scale: 2.5e-3 a m/s²."""
    path = tmp_path / "sensors.csv"
    path.write_text("sensor,x_m,y_m,input,mv_per_m_s2,gain,full_scale_v\nP1,0.1,0.2,3,5,2,4\n")
    (sensor,) = read_sensors(path, rig.plate)
    assert (sensor.name, sensor.x, sensor.y, sensor.input) == ("P1", 0.1, 0.2, 3)
    assert sensor.sensitivity == pytest.approx(2.5e-3)


def phasors(samples: FloatArray, times: FloatArray, frequency: float) -> ComplexArray:
    """Complex amplitudes a of Im[a exp(i omega t)] over whole periods."""
    turning = np.exp(-2j * np.pi * frequency * times)
    return np.asarray(2j * (samples * turning[:, None]).mean(axis=0))


CARD_RATE, LEVEL = 8_000.0, 0.3
PLACES = ((0.03, 0.05), (0.20, 0.11), (0.29, 0.20), (0.11, 0.19), (0.25, 0.03))
SENSORS = tuple(WiredSensor(f"P{n}", x, y, n, 2e-3) for n, (x, y) in enumerate(PLACES, start=1))
LINES = np.arange(51.0, 500.0, 40.0)


def measured(
    rig: Rig,
    truth: Truth,
    *,
    frequencies: FloatArray = LINES,
    **wires: object,
) -> MeasuredPlate:
    """The plate measured from rest."""
    converters = Converters(delay=73, noise=5e-3)
    plate = DeskPlate(truth, SENSORS, rate=CARD_RATE, converters=converters, seed=1)
    card = DeskCard(plate, rate=CARD_RATE, **wires)  # type: ignore[arg-type]
    desk = Desk(rig, SENSORS)
    multisine = Multisine(frequencies, len(desk.eras) + 1, CARD_RATE, LEVEL)
    return measure_through(desk, card, multisine, periods=2, progress=lambda done, of: None)


def test_identified_plate_is_the_one_behind_the_card(rig: Rig, truth: Truth) -> None:
    """Springs per mass, rigidity, gains over frequency: what drove the plate, with resonances.

    Within four standard deviations of what is written, and that is less than before.
    """
    found = identify(rig, measured(rig, truth).measurement)
    assert found.is_explained
    mass = truth.rig.plate.thickness / found.rig.plate.thickness
    std = found.rig.uncertainty
    assert std.stiffness < rig.uncertainty.stiffness / 3
    for era, real, actuator in zip(found.rig.eras, truth.rig.eras, truth.actuators, strict=True):
        assert mass * era.stiffness == pytest.approx(real.stiffness, rel=4 * std.stiffness)
        ratio = era.gain(LINES) / actuator.response(LINES)
        assert np.abs(np.angle(ratio)).max() < 4 * np.radians(std.phase_deg)
        np.testing.assert_allclose(np.abs(ratio), np.abs(ratio).mean(), rtol=4 * std.gain)


@pytest.mark.parametrize(
    ("amplified", "cause"),
    [
        (lambda played, run: played * (1 - 0.1 * (played / LEVEL) ** 2), "half the level"),
        (lambda played, run: played * (0.97 if run == 6 else 1.0), "at the end"),
    ],
    ids=["compressed", "faded"],
)
def test_plate_that_is_not_the_same_twice_is_refused(
    rig: Rig, truth: Truth, amplified: object, cause: str
) -> None:
    """Amplifiers that compress show at half the level, ones that fade in the run that is last."""
    few = np.array([61.0, 151.0, 311.0])
    found = measured(rig, truth, frequencies=few, amplified=amplified)
    with pytest.raises(InputError, match=cause):
        found.measurement.check()


def test_block_that_is_lost_in_a_repeated_run_is_played_again(rig: Rig, truth: Truth) -> None:
    """Once is repeated, three times is refused."""
    few = np.array([61.0, 151.0, 311.0])
    measured(rig, truth, frequencies=few, lost=[5]).measurement.check()
    with pytest.raises(LinkError):
        measured(rig, truth, frequencies=few, lost=[6, 7, 8])
