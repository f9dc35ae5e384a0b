"""Commands of motion as voltages: by hand, and by spectra of sampled voltages."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.command import DriveCommand
from drivers.protocol.messages import Capabilities, Feature
from drivers.voltage.conversion import capabilities_in_motion, to_motion, to_voltage
from registry.voltage import Law, VoltageDrive


def flat(magnitude: float, degrees: float, law: Law, bias: float = 0.0) -> VoltageDrive:
    """An actuator whose response is the same everywhere."""
    rows = tuple((f, magnitude, math.radians(degrees)) for f in (10.0, 1000.0))
    return VoltageDrive(rows, law=law, bias=bias)


@pytest.mark.parametrize(
    ("drive", "asked", "voltage"),
    [
        # 0.5 / 2 = 0.25; 10 + 90 = 100
        (flat(2.0, -90.0, Law.LINEAR), (100.0, 0.5, 10.0), (100.0, 0.25, 100.0)),
        # 0.5 / (2 * 0.25 * 2) = 0.5
        (flat(2.0, 30.0, Law.QUADRATIC, 0.25), (100.0, 0.5, 10.0), (100.0, 0.5, -20.0)),
        # U^2 / 2 * 4 = 0.5, so U = 0.5; 2 theta - 90 + 60 = 0, so theta = 15
        (flat(4.0, 60.0, Law.QUADRATIC), (100.0, 0.5, 0.0), (50.0, 0.5, 15.0)),
    ],
    ids=["linear", "with bias", "without bias"],
)
def test_voltage_by_hand(
    drive: VoltageDrive, asked: tuple[float, float, float], voltage: tuple[float, float, float]
) -> None:
    """Frequency, level and phase of three commands, by hand calculation."""
    found = to_voltage(DriveCommand(3, *asked), drive)
    assert (found.frequency, found.level, found.phase) == pytest.approx(voltage)
    assert found.channel == 3


commands = st.builds(
    DriveCommand,
    st.just(0),
    st.integers(40, 500).map(float),
    st.floats(0.01, 1.0),
    st.floats(-180.0, 180.0),
)
laws = st.sampled_from([(Law.LINEAR, 0.0), (Law.QUADRATIC, 0.0), (Law.QUADRATIC, 0.3)])


@given(commands, laws, st.floats(1.0, 5.0), st.floats(-180.0, 180.0))
def test_drive_term_has_the_commanded_part(
    command: DriveCommand, law: tuple[Law, float], magnitude: float, degrees: float
) -> None:
    """The spectral line of the sampled drive term, times the response, is the command."""
    kind, bias = law
    drive = flat(magnitude, degrees, kind, bias)
    voltage = to_voltage(command, drive)
    times = np.arange(0, 2, 1 / 4000)
    angle = 2 * np.pi * voltage.frequency * times + math.radians(voltage.phase)
    u = bias + voltage.level * np.sin(angle)
    term = u if kind is Law.LINEAR else u**2
    line = 2j * np.mean(term * np.exp(-2j * np.pi * command.frequency * times))
    motion = line * magnitude * np.exp(1j * math.radians(degrees))
    assert motion == pytest.approx(command.phasor, abs=1e-6)
    assert to_motion(voltage, drive).phasor == pytest.approx(command.phasor, abs=1e-9)


def test_halved_phase_continues_on_the_near_side() -> None:
    """From 170 to -170 degrees the voltage turns by 10 degrees, not by 170."""
    drive = flat(1.0, 0.0, Law.QUADRATIC)
    first = to_voltage(DriveCommand(0, 100.0, 0.5, 80.0), drive)
    there = DriveCommand(0, 100.0, 0.5, 100.0, keep_phase=True)
    assert first.phase == pytest.approx(85.0)
    assert to_voltage(there, drive).phase == pytest.approx(-85.0)
    assert to_voltage(there, drive, first).phase == pytest.approx(95.0)


@pytest.mark.parametrize("law", [Law.LINEAR, Law.QUADRATIC])
def test_reply_is_read_at_the_requested_frequency(law: Law) -> None:
    """An amplifier that rounds 149.95 to 150.5 Hz is compared with what it was sent, by its steps.

    Half of 149.95 Hz goes as 75 Hz, for which level and phase are meant.
    """
    rows = ((140.0, 4.0, 0.0), (160.0, 2.0, math.radians(-80.0)))
    drive = VoltageDrive(rows, law=law, frequencies=(140.0, 160.0))
    asked = DriveCommand(0, 149.95, 0.5, 30.0)
    sent = to_voltage(asked, drive)
    assert sent.frequency == (149.95 if law is Law.LINEAR else 75.0)
    meant = 149.95 if law is Law.LINEAR else 150.0
    part = (meant - 140.0) / 20.0
    response = 4.0 + part * (2.0 * cmath.exp(-1j * math.radians(80.0)) - 4.0)
    force = sent.level if law is Law.LINEAR else sent.level**2 / 2
    assert force * abs(response) == pytest.approx(0.5)
    played = replace(sent, frequency=150.5 if law is Law.LINEAR else 75.25)
    found = to_motion(played, drive, requested=149.95)
    assert found.frequency == 150.5
    assert found.phasor == pytest.approx(asked.phasor)


def test_level_is_what_voltage_reaches_at_every_frequency() -> None:
    """Between two rows of opposite phase a response passes through zero: there nothing is reached.

    Else the least of the response counts, at the swing about the bias.
    """
    rows = ((50.0, 4.0, 0.0), (100.0, 2.0, 0.0), (200.0, 6.0, 0.0))
    linear = VoltageDrive(rows, maximum=0.4, frequencies=(60.0, 150.0))
    assert linear.reach() == pytest.approx((0.4 * 2.0, 0.4 * 4.0))
    biased = VoltageDrive(rows, law=Law.QUADRATIC, bias=0.3, maximum=0.8, frequencies=(75.0, 80.0))
    # A supply of one sign: 2 * 0.3 * 0.3 = 0.18; responses 3 at 75 Hz and 2.8 at 80 Hz
    assert biased.reach() == pytest.approx((0.18 * 2.8, 0.18 * 3.0))
    both = replace(biased, minimum=-1.0)  # 2 * 0.3 * 0.5 = 0.3
    assert both.reach() == pytest.approx((0.3 * 2.8, 0.3 * 3.0))
    assert replace(biased, minimum=0.2).swing == pytest.approx(0.1)
    crossing = ((50.0, 1.0, 0.0), (150.0, 1.0, math.pi))
    assert VoltageDrive(crossing, frequencies=(50.0, 150.0)).reach()[0] == pytest.approx(0.0)


@pytest.mark.parametrize(("bias", "minimum"), [(0.0, 0.0), (0.2, -1.0)])
def test_base_stays_within_its_stroke(bias: float, minimum: float) -> None:
    """Samples of the squared voltage at the highest level: its mean deflects, its line moves.

    A response of 4 at the frequency, and 6 to a constant term.
    """
    drive = replace(flat(4.0, 0.0, Law.QUADRATIC, bias), minimum=minimum, static=6.0)
    level = drive.level_max()
    assert level < drive.reach()[0]
    voltage = to_voltage(DriveCommand(0, 100.0, level), drive)
    times = np.arange(0, 1, 1 / 4000)
    term = (bias + voltage.level * np.sin(2 * np.pi * voltage.frequency * times)) ** 2
    line = 2 * abs(np.mean(term * np.exp(-200j * np.pi * times)))
    assert 4 * line + 6 * np.mean(term) == pytest.approx(1.0)
    assert drive.constant_term(level) == pytest.approx(np.mean(term))
    assert replace(drive, static=None).level_max() == drive.reach()[0]


CAPABILITIES = Capabilities(
    channels=2,
    frequency_min=10.0,
    frequency_max=400.0,
    frequency_step=0.05,
    level_max=0.8,
    level_step=1e-4,
    phase_step=0.01,
    ramp_max=1.0,
    watchdog_min=0.1,
    watchdog_max=1.0,
    envelope_knots=32,
    envelope_slots=63,
    envelope_step_min=0.001,
    envelope_step_max=0.1,
    features=Feature.WHOLE | Feature.VOLTAGE,
)


def test_capabilities_are_of_motion() -> None:
    """Without bias frequencies and their steps double, and nothing fades across or is shaped."""
    halved = replace(flat(4.0, 0.0, Law.QUADRATIC), frequencies=(40.0, 300.0))
    found = capabilities_in_motion(CAPABILITIES, {0: halved, 1: halved})
    assert (found.frequency_min, found.frequency_max, found.frequency_step) == (20.0, 800.0, 0.1)
    assert found.level_max == 1.0  # 4 * 0.8^2 / 2 = 1.28
    assert found.level_step == pytest.approx(4 * 0.8 * 1e-4)
    assert found.phase_step == 0.02
    assert not found.has_cross_fades
    assert not found.envelope_knots
    assert found.features == Feature.WHOLE
    measured = replace(CAPABILITIES, features=Feature.WHOLE | Feature.LEVELS_MEASURED)
    found = capabilities_in_motion(measured, {0: halved, 1: halved})
    # Steepest at full voltage, 4 * 0.8; an error of 0.002, half of it in each of two steps.
    assert found.level_step == pytest.approx(4 * 0.8 * (1e-4 + 0.001))
    linear = flat(0.5, 0.0, Law.LINEAR)
    found = capabilities_in_motion(CAPABILITIES, {0: linear, 1: halved})
    assert (found.frequency_min, found.frequency_max) == (20.0, 400.0)
    assert found.level_max == pytest.approx(0.4)
    assert capabilities_in_motion(CAPABILITIES, {0: linear}).has_cross_fades
    held = replace(halved, static=4.0)
    assert capabilities_in_motion(CAPABILITIES, {0: held}).level_max == pytest.approx(0.5)
