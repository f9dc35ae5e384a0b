"""Sensors of a simulated amplifier: bounded memory, what disturbs, what is forgotten."""

import pytest
from sim.amplifier.sensor_messages import SensedAmplifier

from drivers.command import CommandSet, DriveCommand
from drivers.protocol.messages import (
    Apply,
    Arm,
    GetBlock,
    GetReading,
    GetSensors,
    Measure,
    Nak,
    NakCode,
    Reading,
    ReadingState,
    SampleBlock,
    SensorList,
    Stop,
)
from model.rig.rig import Rig
from sim.bench.bench import Bench
from sim.bench.reading import KEPT_SAMPLES
from wires import on_two_amplifiers

SESSION = 9


def reading(bench: Bench, now: float) -> Reading:
    """The reading at a time [s]."""
    found = bench.exchange("main", GetReading(), now=now)
    assert isinstance(found, Reading)
    return found


def test_newest_raw_samples_of_a_long_window_are_kept(coarse_rig: Rig) -> None:
    """Ten seconds at 10 kHz are 100000 samples; asked from 0 on, the oldest kept come first."""
    bench = Bench(coarse_rig, now=5.0, make_amplifier=SensedAmplifier)
    bench.exchange("main", Measure(7, 10.0, (110.0,)), now=5.0)
    assert bench.probes
    block = bench.exchange("main", GetBlock(0, 0), now=16.0)
    assert isinstance(block, SampleBlock)
    assert (block.end, block.first) == (100_000, 100_000 - KEPT_SAMPLES)
    assert not bench.probes  # the plate is no longer sampled
    assert bench.exchange("main", GetBlock(4, 0), now=16.0) == Nak(NakCode.BAD_VALUE)


def test_end_of_a_vibration_disturbs_a_reading(coarse_rig: Rig) -> None:
    """`valid_for` ends within the window; after the window nothing does."""
    bench = Bench(coarse_rig, now=5.0, make_amplifier=SensedAmplifier)
    bench.exchange("main", Arm(2.0, SESSION), now=5.0)
    played = CommandSet(1, (DriveCommand(0, 110.0, 0.1),), ramp=0.0, valid_for=0.1)
    bench.exchange("main", Apply(played, SESSION), now=5.0)
    bench.exchange("main", Measure(1, 0.1, (110.0,)), now=5.05)
    assert reading(bench, 5.2).state is ReadingState.DISTURBED
    bench.exchange("main", Measure(2, 0.1, (110.0,)), now=5.2)
    bench.exchange("main", Stop(0.0), now=5.31)
    assert reading(bench, 5.4).state is ReadingState.COMPLETE
    assert reading(bench, 5.4).token == 1


def test_repeated_measure_goes_on_with_its_window(coarse_rig: Rig) -> None:
    """Its reply was lost; another number begins anew."""
    bench = Bench(coarse_rig, now=5.0, make_amplifier=SensedAmplifier)
    for now, number, left in ((5.0, 3, 0.1), (5.04, 3, 0.06), (5.06, 4, 0.1)):
        found = bench.exchange("main", Measure(number, 0.1, (110.0,)), now=now)
        assert isinstance(found, Reading)
        assert (found.number, found.left) == (number, pytest.approx(left))


def test_each_amplifier_has_the_sensors_of_its_own_eras(coarse_rig: Rig) -> None:
    """By the wiring; a reading of one is none of the other's."""
    bench = Bench(on_two_amplifiers(coarse_rig), now=5.0, make_amplifier=SensedAmplifier)
    places = []
    for name in ("east", "west"):
        found = bench.exchange(name, GetSensors(), now=5.0)
        assert isinstance(found, SensorList)
        assert [one.channel for one in found.sensors] == [0, 1]
        places += [(one.x, one.y) for one in found.sensors]
    assert len(set(places)) == 4
    bench.exchange("east", Measure(1, 0.1, (110.0,)), now=5.0)
    other = bench.exchange("west", GetReading(), now=5.0)
    assert other == Reading(0, ReadingState.NONE)


@pytest.mark.parametrize(
    "request_",
    [
        Measure(1, 0.1, (3000.05,)),
        Measure(1, 0.1, (9.0,)),
        Measure(1, 0.1, (110.0, 119.0)),
        Measure(1, 0.1, ()),
    ],
    ids=["beyond the sensors", "less than a period", "too close", "none"],
)
def test_tones_out_of_range_are_refused(request_: Measure, coarse_rig: Rig) -> None:
    """And measure nothing."""
    bench = Bench(coarse_rig, now=5.0, make_amplifier=SensedAmplifier)
    assert bench.exchange("main", request_, now=5.0) == Nak(NakCode.BAD_VALUE)
    assert reading(bench, 5.0).state is ReadingState.NONE
