"""A whole rig in numbers: from a request to what a finger feels, on a virtual clock."""

import asyncio
import json
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from drivers.playing import Tone
from firmware_machine import bench_driving_arm, keep_alive, play
from model.arrays import FloatArray
from model.fem import assemble
from model.finger import fingertip_points
from model.rig.rig import Rig
from model.structure.attachments import Fingertip, FingertipLoad
from plates import apart, lock_in
from sim.bench.bench import Bench
from sim.control import SimulationContext, carry_out
from sim.plant.fingers import Accelerometer
from sim.plant.plant import LoadedPlate, Placement
from sim.sensors import Accelerometers

START = 98765.4321  # as large as a clock may be


def test_bench_watchdog_silences_at_its_time(coarse_rig: Rig) -> None:
    """Noticed two seconds late, the plate has been ringing down since the watchdog ran out."""
    prompt, late = Bench(coarse_rig, now=START), Bench(coarse_rig, now=START)
    for bench in (prompt, late):
        bench.place_fingers({"a": (0.1, 0.1)}, now=START)
        bench_driving_arm(bench, 0.25, now=START)
        play(bench, Tone(1, 110.0, 1.0), now=START + 0.1, token=1, ramp=0.02)
    for step in range(1, 401):
        prompt.advance(START + 0.1 + step * 0.005)
    for bench in (prompt, late):
        bench.advance(START + 2.1)
        assert bench.amplifiers["main"].fault == "WATCHDOG"
    window = START + 0.3, START + 0.5
    np.testing.assert_allclose(
        late.felt(*window)["a"].peak, prompt.felt(*window)["a"].peak, rtol=1e-4
    )
    driven = late.felt(START + 0.25, START + 0.35)["a"].peak.max()
    assert late.felt(START + 1.9, START + 2.1)["a"].peak.max() < 0.02 * driven


class Listener:
    """A probe at one point that keeps what it is given."""

    def __init__(self, bench: Bench) -> None:
        self.shapes = bench.shapes_at(np.array([[0.1, 0.1]]))
        self.times: list[float] = []
        self.accelerations: list[float] = []

    def record(self, times: FloatArray, accelerations: FloatArray) -> None:
        """Keep samples."""
        self.times += times.tolist()
        self.accelerations += accelerations[:, 0].tolist()


def test_bench_record_is_independent_of_when_it_is_read(coarse_rig: Rig) -> None:
    """Read every 3 ms, or once at the end: the same samples of a finger; a probe gets its own."""
    records, listeners = [], []
    for is_read in (True, False):
        bench = Bench(coarse_rig, now=START)
        bench.place_fingers({"a": (0.1, 0.1)}, now=START)
        bench_driving_arm(bench, 2.0, now=START)
        for step in range(1, 101):
            now = START + 0.003 * step
            if step in (20, 45, 70):  # at 20 abruptly
                tone = Tone(step % 4, 100.0 + step, 1.0)
                play(bench, tone, now=now, token=step, ramp=0.001 * (step - 20))
            bench.advance(now)
            if step == 60:
                listener = Listener(bench)
                bench.probes.append(listener)
            if is_read:
                bench.records(START, now)
        records.append(bench.records(START, bench.time)[0]["a"])
        listeners.append(listener)
    read, unread = records
    np.testing.assert_array_equal(unread.times, read.times)
    np.testing.assert_allclose(np.diff(read.times), 1e-4, rtol=1e-4)
    peak = np.abs(read.accelerations).max()
    np.testing.assert_allclose(unread.accelerations, read.accelerations, atol=1e-6 * peak)
    for listener in listeners:
        count = len(listener.times)
        np.testing.assert_array_equal(listener.times, read.times[-count:])
        assert START + 0.18 < listener.times[0] < START + 0.1803
        centre = read.accelerations[-count:, 0]
        np.testing.assert_allclose(listener.accelerations, centre, atol=1e-6 * peak)


def test_bench_skips_a_long_pause(coarse_rig: Rig) -> None:
    """A process that was paused for a day comes back to a silent plate, ten seconds recorded."""
    bench = Bench(coarse_rig, now=0.0)
    bench.place_fingers({"a": (0.1, 0.1)}, now=0.0)
    bench_driving_arm(bench, 0.25, now=0.0)
    play(bench, Tone(1, 110.0, 1.0), now=0.1, token=1, ramp=0.02)
    bench.advance(86_400.0)
    felt = bench.felt(86_400.0 - 9.9, 86_400.0)
    assert felt["a"].peak.max() < 1e-9
    assert bench.fingers.felt(0.0, 86_400.0)["a"].times[0] >= 86_390.0


A, B = (0.1, 0.07), (0.29, 0.2)
FREQUENCY = 210.0
FULL_STROKE = Tone(1, FREQUENCY, 1.0)


def expected(rig: Rig, loads: tuple[FingertipLoad, ...]) -> FloatArray:
    """Amplitudes [m/s²] under finger A by the direct solve, one ERA at full stroke."""
    points = fingertip_points(*A, rig.plate)
    matrices = assemble(rig.plate, rig.mesh)
    answer = direct_acceleration(matrices, rig.eras, np.array([FREQUENCY]), points, loads=loads)
    return np.asarray(np.abs(answer[0, 1]))


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


PLACE_A, PLACE_B, C = (0.1, 0.07), (0.29, 0.2), (0.2, 0.1)


@pytest.fixture
def rig(coarse_rig: Rig) -> Rig:
    """A rig whose fingers load the plate."""
    return replace(coarse_rig, fingertip=Fingertip(2000.0, 3.0, 0.005))


@pytest.fixture
def let_solve(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Solutions wait for this event."""
    event, solved = threading.Event(), Placement.solved

    def wait(placement: Placement) -> LoadedPlate | None:
        assert event.wait(60)
        return solved(placement)

    monkeypatch.setattr(Placement, "solved", wait)
    return event


def driven(rig: Rig, place: Callable[[Bench], None]) -> Bench:
    """A bench that plays on through a touch at 0.5 s, up to 1.2 s."""
    bench = Bench(rig, now=0.0)
    bench.place_fingers({"a": PLACE_A}, now=0.0)
    play(bench, Tone(1, 210.0, 1.0), now=bench.time, ramp=0.02, watchdog=2.0)
    keep_alive(bench, 0.5)
    place(bench)
    keep_alive(bench, 1.2)
    return bench


def test_finger_that_is_solved_late_is_felt_as_one_that_is_solved_at_once(rig: Rig) -> None:
    """The plate waits for it, so that samples before and after it are the same."""
    late = driven(rig, lambda one: one.begin_placing({"a": PLACE_A, "b": PLACE_B}, now=one.time))
    at_once = driven(rig, lambda one: one.place_fingers({"a": PLACE_A, "b": PLACE_B}, now=one.time))
    for since, until in ((0.1, 0.5), (0.51, 1.2)):
        ours, theirs = (bench.records(since, until)[0] for bench in (late, at_once))
        assert ours.keys() == theirs.keys()
        for name, record in ours.items():
            np.testing.assert_array_equal(record.times, theirs[name].times)
            peak = np.abs(theirs[name].accelerations).max()
            np.testing.assert_allclose(
                record.accelerations, theirs[name].accelerations, rtol=0, atol=1e-5 * peak
            )
    assert late.unsolved is None


def test_slide_faster_than_it_is_solved_leaves_out_places_between(rig: Rig) -> None:
    """Of a finger's landing, three moves and its lift, two moves are never solved."""
    bench = Bench(rig, now=0.0)
    for number, at in enumerate((PLACE_A, PLACE_B, C, PLACE_A)):
        bench.begin_placing({"a": at}, now=0.02 * number)
    bench.begin_placing({}, now=0.1)
    solved = []
    while (placement := bench.unsolved) is not None:
        placement.solved()
        solved.append((placement.time, placement.positions))
    assert solved == [(0.0, {"a": PLACE_A}), (pytest.approx(0.06), {"a": PLACE_A}), (0.1, {})]


async def test_control_replies_while_the_plate_is_solved(
    rig: Rig, let_solve: threading.Event
) -> None:
    """A finger comes and the state is read before its plate is solved; what it feels waits."""
    context = SimulationContext(Bench(rig, now=0.0))

    async def ask(now: float, **request: object) -> dict[str, object]:
        return await carry_out(context, json.dumps(request).encode(), now=now)

    assert (await ask(0.1, op="fingers", fingers={"a": PLACE_A}))["ok"]
    assert (await ask(0.4, op="state"))["fingers"] == {"a": list(PLACE_A)}
    felt = asyncio.create_task(ask(0.4, op="felt", since_s=0.1, until_s=0.4))
    await asyncio.sleep(0)
    assert context.bench.unsolved is not None
    let_solve.set()
    fingers = (await felt)["fingers"]
    assert isinstance(fingers, dict)
    assert fingers.keys() == {"a"}
    await context.stop_solving()
