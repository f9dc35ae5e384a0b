"""A whole simulated rig on a virtual clock: from a request to the vibration at a finger.

What voices do to the plate follows the clock of their amplifier, with its law, crystal and rate.
"""

import asyncio
import json
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from drivers.playing import AmplifierTone
from drivers.voices import Voice, VoiceTransition
from kit.direct_plate import direct_acceleration
from kit.plates import apart, lock_in
from model.arrays import FloatArray
from model.fem import assemble
from model.finger import fingertip_points
from model.rig.rig import Rig
from model.structure.fingertips import Fingertip, FingertipLoad
from registry.limits import HAND_LOAD
from sim.amplifier.amplifier_clock import AmplifierClock, Crystal
from sim.bench.bench import Bench
from sim.control import SimulationContext, execute
from sim.plant.era_motions import motion_of
from sim.plant.finger_placement import FingerPlacement
from sim.plant.imperfections import Imperfections
from tests.sim.armed_bench import SESSION as BENCH_SESSION
from tests.sim.armed_bench import keep_alive
from tests.sim.armed_bench import play as play_at_once

AT = (0.08, 0.06)


def phases(bench: Bench, times: tuple[float, ...], *frequencies: float) -> np.ndarray:
    """Phases [rad] (t, f) of tones at the finger, mean of the half second before each time [s]."""
    angles = []
    for time in times:
        keep_alive(bench, time)
        (record,) = bench.sample_fingers().felt(time - 0.5, time).values()
        samples = record.accelerations[:, 0]
        angles.append(
            [np.angle(lock_in(record.times, samples, frequency)) for frequency in frequencies]
        )
    return np.array(angles)


def test_angle_is_the_frequency_word_times_the_clock(two_amplifiers: Rig) -> None:
    """In integers, across the end of a turn and hours later, for any start of the voice."""
    clock = AmplifierClock(Crystal(error=30e-6, ahead=11.0))
    clock.steer(-123, 40.0)
    for time in (41.3, 48.9999, 49.0001, 20_000.7):
        for word, began in ((1999, 41.0), (2000, time - 0.01), (9037, time)):
            way = VoiceTransition(began, 0.0, 0j, 1 + 0j, began)
            (term,) = motion_of([Voice(0, word / 20, began, way)], clock.straight(time), stroke=1.0)
            angle = term.omega * (time - term.start)
            moved = (term.c0 * complex(math.cos(angle), math.sin(angle))).imag
            turns = (word * clock.reading(time)) % 2**32 / 2**32
            # The clock is read to half a step: 9037 / 2 of 2^32 parts of a turn, 7e-6 rad.
            assert moved == pytest.approx(math.sin(2 * math.pi * turns), abs=1e-5)


def test_crystals_drift_apart_at_the_plate(two_amplifiers: Rig) -> None:
    """At +40 and -30 ppm, two amplifiers move apart by 70 us each second, until one is steered."""
    crystals = {"left": Crystal(error=40e-6), "right": Crystal(error=-30e-6)}
    bench = Bench(two_amplifiers, now=0.0, imperfections=Imperfections(crystals=crystals))
    bench.place_fingers({"a": AT}, now=0.0)
    for name, frequency in (("left", 110.0), ("right", 170.0)):
        play_at_once(
            bench, AmplifierTone(0, frequency, 0.5), now=0.0, name=name, watchdog=2.0, ramp=0.02
        )
    angles = phases(bench, (3.0, 5.0), 110.0, 170.0)
    left_delay, right_delay = (angles[1] - angles[0]) / (2 * math.pi * np.array([110.0, 170.0]))
    assert (left_delay, right_delay) == pytest.approx((80e-6, -60e-6), abs=0.5e-6)
    for step in range(200):  # 70 ppm slower, it is as slow as the other
        bench.exchange(
            "left",
            "Ping",
            {"session": BENCH_SESSION, "rate": -700},
            now=5.05 + step / 20,
        )
    steered = phases(bench, (15.5,), 110.0)[0, 0] - angles[1, 0]
    # From 4.75 s to 5.05 s as before, and to 15.25 s so.
    expected = 0.3 * 40e-6 - 10.2 * 30e-6
    assert steered / (2 * math.pi * 110) == pytest.approx(expected, abs=1e-6)


A, B = (0.1, 0.07), (0.29, 0.2)
HAND = (0.2, 0.1)
FREQUENCY = 210.0
FULL_STROKE = AmplifierTone(1, FREQUENCY, 1.0)


def expected(rig: Rig, loads: tuple[FingertipLoad, ...]) -> FloatArray:
    """Amplitudes [m/s²] under finger A by the direct solve, one ERA at full stroke."""
    points = fingertip_points(*A, rig.plate)
    matrices = assemble(rig.plate, rig.mesh)
    answer = direct_acceleration(matrices, rig.eras, np.array([FREQUENCY]), points, loads=loads)
    return np.asarray(np.abs(answer[0, 1]))


def test_bench_observers_have_no_weight(coarse_rig: Rig) -> None:
    """A rig without fingertips has unloaded fingers; elsewhere an observer loads nothing."""
    bare = Bench(replace(coarse_rig, fingertip=None), now=0.0)
    observed = Bench(replace(coarse_rig, fingertip=Fingertip(contact_mass=0.02)), now=0.0)
    bare.place_fingers({"a": A, "b": B}, now=0.0)
    observed.place_fingers({"a": A, "b": B}, now=0.0, observers={"a", "b"})
    for bench in (bare, observed):
        play_at_once(bench, FULL_STROKE, now=bench.time, ramp=0.02, watchdog=2.0)
        keep_alive(bench, 4.0)
        (amplitude,) = bench.felt(3.5, 4.0)["a"].amplitude
        assert apart(amplitude, expected(coarse_rig, ())) < 0.01


def test_bench_hand_rests_on_four_patches(coarse_rig: Rig) -> None:
    """A hand of twelve fingertips agrees with four loads of three each in the direct solve."""
    tip = Fingertip(contact_mass=0.002)
    bench = Bench(replace(coarse_rig, fingertip=tip), now=0.0)
    hand = {"hand": HAND_LOAD}
    bench.place_fingers({"a": A, "hand": HAND}, now=0.0, observers={"a"}, loads=hand)
    play_at_once(bench, FULL_STROKE, now=bench.time, ramp=0.02, watchdog=2.0)
    keep_alive(bench, 4.0)
    (amplitude,) = bench.felt(3.5, 4.0)["a"].amplitude
    corners = product((HAND[0] - 0.0125, HAND[0] + 0.0125), (HAND[1] - 0.0125, HAND[1] + 0.0125))
    patches = tuple(FingertipLoad(x, y, tip.multiplied(HAND_LOAD / 4)) for x, y in corners)
    assert apart(amplitude, expected(coarse_rig, patches)) < 0.01


def test_bench_sensors_read_through_a_touch(coarse_rig: Rig) -> None:
    """An observer is recorded correctly at every sample while a finger arrives."""
    tip = Fingertip(contact_mass=0.005)
    bench = Bench(replace(coarse_rig, fingertip=tip), now=0.0)
    sensor = {"P1": (0.2, 0.03)}
    bench.place_fingers(sensor, now=0.0, observers=sensor)
    play_at_once(bench, FULL_STROKE, now=bench.time, ramp=0.02, watchdog=2.0)
    keep_alive(bench, 1.0)
    bench.place_fingers({**sensor, "b": B}, now=1.0, observers=sensor)
    keep_alive(bench, 4.0)
    recording = bench.sample_fingers().felt(0.0, 4.0)["P1"]
    np.testing.assert_allclose(np.diff(recording.times), 1e-4, rtol=1e-6)
    late = recording.times > 3.5
    amplitude = abs(lock_in(recording.times[late], recording.accelerations[late, 0], FREQUENCY))
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


def driven(rig: Rig, place: Callable[[Bench], None]) -> Bench:
    """A bench that plays on through a touch at 0.5 s, up to 1.2 s."""
    bench = Bench(rig, now=0.0)
    bench.place_fingers({"a": PLACE_A}, now=0.0)
    play_at_once(bench, AmplifierTone(1, 210.0, 1.0), now=bench.time, ramp=0.02, watchdog=2.0)
    keep_alive(bench, 0.5)
    place(bench)
    keep_alive(bench, 1.2)
    return bench


def test_finger_that_is_solved_late_is_felt_as_one_that_is_solved_at_once(rig: Rig) -> None:
    """The plate waits for the solution, so that earlier and later samples agree."""
    late = driven(
        rig, lambda bench: bench.begin_placing({"a": PLACE_A, "b": PLACE_B}, now=bench.time)
    )
    at_once = driven(
        rig, lambda bench: bench.place_fingers({"a": PLACE_A, "b": PLACE_B}, now=bench.time)
    )
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
    """Two of three moves between a finger's landing and lift are never solved."""
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
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state is read before the plate with a new finger is solved; its vibration waits."""
    may_solve, solved = threading.Event(), FingerPlacement.solved
    monkeypatch.setattr(
        FingerPlacement, "solved", lambda placement: may_solve.wait(60) and solved(placement)
    )
    context = SimulationContext(Bench(rig, now=0.0))

    async def ask(now: float, **request: object) -> dict[str, object]:
        return await execute(context, json.dumps(request).encode(), now=now)

    assert (await ask(0.1, op="fingers", fingers={"a": PLACE_A}))["ok"]
    assert (await ask(0.4, op="state"))["fingers"] == {"a": list(PLACE_A)}
    felt = asyncio.create_task(ask(0.4, op="felt", since_s=0.1, until_s=0.4))
    await asyncio.sleep(0)
    assert context.bench.unsolved is not None
    may_solve.set()
    assert set((await felt)["fingers"]) == {"a"}
    await context.stop_solving()
