"""Fingers that load the plate of the bench, against the direct solve with what they weigh."""

from dataclasses import replace

import numpy as np
import pytest

from bench_driving import keep_alive, play
from drivers.contents import Tone
from model.arrays import FloatArray
from model.fem.plate import assemble, direct_acceleration
from model.finger.fingertip import fingertip_points
from model.rig.rig import Rig
from model.structure.attachments import Fingertip, FingertipLoad
from plate_in_time import apart, lock_in
from sim.bench.bench import Bench
from sim.plant.accelerometer import Accelerometer
from sim.sensors.recorder import Accelerometers

A, B = (0.1, 0.07), (0.29, 0.2)
FREQUENCY = 210.0
FULL_STROKE = Tone(1, FREQUENCY, 1.0)


def expected(rig: Rig, loads: tuple[FingertipLoad, ...]) -> FloatArray:
    """Amplitudes [m/s²] under finger A by the direct solve, one ERA at full stroke."""
    points = fingertip_points(*A, rig.plate)
    matrices = assemble(rig.plate, rig.mesh)
    answer = direct_acceleration(matrices, rig.eras, np.array([FREQUENCY]), points, loads=loads)
    return np.asarray(np.abs(answer[0, 1]))


def test_bench_fingers_load_the_plate(coarse_rig: Rig) -> None:
    """What A feels alone, after B came, and after B went, each once the plate has settled."""
    tip = Fingertip(2000.0, 3.0, 0.005)
    bench = Bench(replace(coarse_rig, fingertip=tip), now=0.0)
    bench.place_fingers({"a": A}, now=0.0)
    play(bench, FULL_STROKE, now=bench.time, ramp=0.02, watchdog=2.0)
    for positions in ({"a": A}, {"a": A, "b": B}, {"a": A}):
        bench.place_fingers(positions, now=bench.time)
        keep_alive(bench, bench.time + 4)
        truth = expected(coarse_rig, tuple(FingertipLoad(*at, tip) for at in positions.values()))
        (amplitude,) = bench.felt(bench.time - 0.5, bench.time)["a"].amplitude
        assert apart(amplitude, truth) < 0.005
    assert (
        apart(truth, expected(coarse_rig, (FingertipLoad(*A, tip), FingertipLoad(*B, tip)))) > 0.02
    )


def test_bench_fingers_press_harder_where_they_are(coarse_rig: Rig) -> None:
    """A finger with twice the load and one with half of it, each once the plate has settled."""
    tip = Fingertip(2000.0, 3.0, 0.005)
    bench = Bench(replace(coarse_rig, fingertip=tip), now=0.0)
    bench.place_fingers({"a": A, "b": B}, now=0.0)
    play(bench, FULL_STROKE, now=bench.time, ramp=0.02, watchdog=2.0)
    truths = []
    for loads in ({"b": 2.0}, {"a": 0.5}):
        bench.place_fingers({"a": A, "b": B}, now=bench.time, loads=loads)
        keep_alive(bench, bench.time + 4)
        tips = [tip.scaled(loads.get(name, 1.0)) for name in "ab"]
        fingers = [FingertipLoad(*at, each) for at, each in zip((A, B), tips, strict=True)]
        truths.append(expected(coarse_rig, tuple(fingers)))
        (amplitude,) = bench.felt(bench.time - 0.5, bench.time)["a"].amplitude
        assert apart(amplitude, truths[-1]) < 0.005
    assert apart(*truths) > 0.02


def test_bench_observers_have_no_weight(coarse_rig: Rig) -> None:
    """Fingers of a rig with none load nothing; where fingers do, an observer does not."""
    bare = Bench(replace(coarse_rig, fingertip=None), now=0.0)
    observed = Bench(replace(coarse_rig, fingertip=Fingertip(contact_mass=0.02)), now=0.0)
    bare.place_fingers({"a": A, "b": B}, now=0.0)
    observed.place_fingers({"a": A, "b": B}, now=0.0, observers={"a", "b"})
    for bench in (bare, observed):
        play(bench, FULL_STROKE, now=bench.time, ramp=0.02, watchdog=2.0)
        keep_alive(bench, 4.0)
        (amplitude,) = bench.felt(3.5, 4.0)["a"].amplitude
        assert apart(amplitude, expected(coarse_rig, ())) < 0.01


def test_bench_sensors_read_through_a_touch(coarse_rig: Rig) -> None:
    """An accelerometer hears the whole time while a finger comes, at every sample, truly."""
    tip = Fingertip(contact_mass=0.005)
    bench = Bench(replace(coarse_rig, fingertip=tip), now=0.0)
    sensors = Accelerometers(bench)
    sensors.place([Accelerometer("P1", 0.2, 0.03)])
    play(bench, FULL_STROKE, now=bench.time, ramp=0.02, watchdog=2.0)
    keep_alive(bench, 1.0)
    bench.place_fingers({"b": B}, now=1.0)
    keep_alive(bench, 4.0)
    recording = sensors.read(0.0, 4.0)
    np.testing.assert_allclose(np.diff(recording.times), 1e-4, rtol=1e-6)
    late = recording.times > 3.5
    amplitude = abs(lock_in(recording.times[late], recording.samples[late, 0], FREQUENCY))
    answer = direct_acceleration(
        assemble(coarse_rig.plate, coarse_rig.mesh),
        coarse_rig.eras,
        np.array([FREQUENCY]),
        np.array([[0.2, 0.03]]),
        loads=[FingertipLoad(*B, tip)],
    )
    assert amplitude == pytest.approx(abs(answer[0, 1, 0]), rel=0.01)
