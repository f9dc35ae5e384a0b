"""Clocks of two amplifiers that are off, found by the sensors of a hidden plate."""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.identification.hidden import draw
from model.identification.forward import ForwardModel, Sensor
from model.identification.identify import (
    Identification,
    as_json,
    clock_estimates,
    clock_rows,
    identify,
)
from model.identification.least_squares import Measurement
from model.identification.parameters import space_of
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Channel, Rig
from model.rig.rig_file import example_rig_path, load_rig
from plates import SETTLED_PATTERNS_FREQUENCIES

LATE = 30e-6
"""Delay of amplifier b [s]."""

OF = np.array([0, 0, 1, 1])


def halves() -> tuple[Rig, list[Sensor]]:
    """The paper's plate on two amplifiers of two ERAs, each with sensors at these."""
    rig = load_rig(example_rig_path())
    wiring = {era.name: Channel("ab"[OF[n]], n % 2) for n, era in enumerate(rig.eras)}
    rig = replace(rig, wiring=wiring, amplifiers={"a": "sim://", "b": "sim://"})
    sensors = [Sensor(era, era, amplifier=at.amplifier) for era, at in wiring.items()]
    return rig, sensors


@pytest.fixture(scope="module")
def found() -> Identification:
    """Identified by tones that b plays late and, with the same clock, hears as early."""
    rig, sensors = halves()
    values = draw("form", 1).measured(SETTLED_PATTERNS_FREQUENCIES, np.random.default_rng(1))
    late = LATE * (OF[None, :] - OF[:, None])
    values = values * np.exp(-2j * math.pi * SETTLED_PATTERNS_FREQUENCIES[:, None, None] * late)
    measurement = Measurement.of(sensors, SETTLED_PATTERNS_FREQUENCIES, values)
    return identify(rig, replace(measurement, clock_errors={"a": 4e-6, "b": 4e-6}))


def test_a_constant_delay_is_found_and_taken_off(found: Identification) -> None:
    """Within 5 us of 30, far below the 60 degrees of a gain; the rig's gains of b turn by it."""
    (clock,) = clock_estimates(found)
    assert clock.amplifier == "b"
    assert clock.delay_us == pytest.approx(1e6 * LATE, abs=5)
    assert clock.error_us < 3
    assert found.is_explained
    (shown,) = as_json(found, ())["clocks"]
    assert shown["delay_us"] == clock.delay_us
    tones = np.array([100.0, 400.0])
    for era in found.rig.eras[2:]:
        low, high = np.angle(era.gain(tones))
        slope = math.remainder(high - low, 2 * math.pi) / (2 * math.pi * 300.0)
        assert slope == pytest.approx(-LATE, abs=5e-6)
    assert all(len(era.gains) == 1 for era in found.rig.eras[:2])


@pytest.mark.parametrize(("stated", "is_believed"), [(4e-6, False), (17e-6, True)])
def test_a_clock_that_is_off_by_more_than_is_stated_is_accused(
    found: Identification, stated: float, is_believed: bool
) -> None:
    """30 us are more than four times what two clocks of 4 us make, and less than of 17."""
    problem = found.fitted.problem
    measurement = replace(problem.measurement, clock_errors={"a": stated, "b": stated})
    fitted = replace(found.fitted, problem=replace(problem, measurement=measurement))
    claimed = replace(found, fitted=fitted)
    (clock,) = clock_estimates(claimed)
    assert clock.is_believed == is_believed
    assert len(clock_rows(claimed)) == 1 + (not is_believed)


def test_phases_turn_with_the_delays_of_who_plays_and_who_hears() -> None:
    """By hand: exp(-2 pi i f d) between amplifiers, nothing within one; slopes by differences."""
    rig, sensors = halves()
    space = space_of(rig, [each.name for each in sensors], rig.uncertainty, amplifiers=["a", "b"])
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=500.0)
    tones = np.array([60.0, 240.0])
    model = ForwardModel(rig, sensors, tones, space, free, amplifiers=["a", "b"])
    x = np.zeros(space.size)
    exact = model.at(x).responses
    number = space.index("delay of amplifier b")
    x[number] = LATE / space.std[number]
    turned = np.angle(model.at(x).responses / exact)
    by_hand = -2 * math.pi * tones[:, None, None] * LATE * (OF[None, :] - OF[:, None])
    np.testing.assert_allclose(turned, by_hand, atol=1e-9)
    assert space.std[space.index("delay of amplifier a")] == 0
