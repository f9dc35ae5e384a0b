"""What voices do to the plate follows the clock of their amplifier: its law, crystal and rate."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from drivers.playing import Tone, Transition, Voice
from firmware_machine import SESSION, keep_alive, play
from model.rig.rig import Channel, Rig
from plates import lock_in
from sim.amplifier.readings import AmplifierClock, Crystal
from sim.bench.bench import WRONG, Bench, StraightClocks
from sim.plant.imperfections import Imperfections, motion_of

AT = (0.08, 0.06)


@pytest.fixture(scope="module")
def two_amplifiers(coarse_rig: Rig) -> Rig:
    """The paper's plate; two ERAs on one amplifier, two on another."""
    wiring = {
        era.name: Channel("left" if number < 2 else "right", number % 2)
        for number, era in enumerate(coarse_rig.eras)
    }
    return replace(coarse_rig, wiring=wiring, amplifiers={"left": "sim://", "right": "sim://"})


def phases(bench: Bench, times: tuple[float, ...], *frequencies: float) -> np.ndarray:
    """Phases [rad] (t, f) of tones at the finger, mean of the half second before each time [s]."""
    found = []
    for time in times:
        keep_alive(bench, time)
        (record,) = bench.fingers.felt(time - 0.5, time).values()
        samples = record.accelerations[:, 0]
        found.append([np.angle(lock_in(record.times, samples, each)) for each in frequencies])
    return np.array(found)


def test_angle_is_the_frequency_word_times_the_clock(two_amplifiers: Rig) -> None:
    """In whole numbers, over the end of a turn and hours later, whenever the voice has begun."""
    clock = AmplifierClock(Crystal(error=30e-6, ahead=11.0))
    clock.steer(-123, 40.0)
    for time in (41.3, 48.9999, 49.0001, 20_000.7):
        for word, began in ((1999, 41.0), (2000, time - 0.01), (9037, time)):
            way = Transition(began, 0.0, 0j, 1 + 0j, began)
            (term,) = motion_of([Voice(0, word / 20, began, way)], clock.straight(time), stroke=1.0)
            angle = term.omega * (time - term.start)
            moved = (term.c0 * complex(math.cos(angle), math.sin(angle))).imag
            turns = (word * clock.reading(time)) % 2**32 / 2**32
            # The clock is read to half a step: 9037 / 2 of 2^32 parts of a turn, 7e-6 rad.
            assert moved == pytest.approx(math.sin(2 * math.pi * turns), abs=1e-5)


def test_tone_goes_on_where_the_clock_goes_round(coarse_rig: Rig) -> None:
    """A steady tone of 110.05 Hz has no step and no new phase at 20 s and at 40 s."""
    bench = Bench(coarse_rig, now=18.0)
    bench.place_fingers({"a": AT}, now=18.0)
    play(bench, Tone(0, 110.05, 0.5), now=18.0, watchdog=2.0, ramp=0.02)
    before, over, after = phases(bench, (19.9, 20.4, 40.3), 110.05)
    assert before == pytest.approx(over, abs=1e-5)
    assert before == pytest.approx(after, abs=1e-5)


def test_crystals_drift_apart_at_the_plate(two_amplifiers: Rig) -> None:
    """At +40 and -30 ppm, two amplifiers move apart by 70 us each second, until one is steered."""
    crystals = {"left": Crystal(error=40e-6), "right": Crystal(error=-30e-6)}
    bench = Bench(two_amplifiers, now=0.0, imperfections=Imperfections(crystals=crystals))
    bench.place_fingers({"a": AT}, now=0.0)
    for name, frequency in (("left", 110.0), ("right", 170.0)):
        play(bench, Tone(0, frequency, 0.5), now=0.0, name=name, watchdog=2.0, ramp=0.02)
    found = phases(bench, (3.0, 5.0), 110.0, 170.0)
    left, right = (found[1] - found[0]) / (2 * math.pi * np.array([110.0, 170.0]))
    assert (left, right) == pytest.approx((80e-6, -60e-6), abs=0.5e-6)
    for step in range(200):  # 70 ppm slower, it is as slow as the other
        bench.exchange("left", "Ping", {"session": SESSION, "rate": -700}, now=5.05 + step / 20)
    steered = phases(bench, (15.5,), 110.0)[0, 0] - found[1, 0]
    # From 4.75 s to 5.05 s as before, and to 15.25 s so.
    expected = 0.3 * 40e-6 - 10.2 * 30e-6
    assert steered / (2 * math.pi * 110) == pytest.approx(expected, abs=1e-6)


def test_shift_is_of_the_phase(coarse_rig: Rig) -> None:
    """Arm with 5 steps of 20 s / 65536 lets a tone of 110 Hz lead by 60.4 degrees."""
    found = []
    for shift in (0, 5):
        bench = Bench(coarse_rig, now=0.0)
        bench.place_fingers({"a": AT}, now=0.0)
        values = {"session": SESSION, "watchdog": 2000, "shift": shift}
        bench.exchange("main", "Arm", values, now=0.0)
        play(bench, Tone(0, 110.0, 0.5), now=0.1)
        found.append(phases(bench, (3.0,), 110.0)[0, 0])
    assert math.degrees(found[1] - found[0]) == pytest.approx(360 * 110 * 5 * 20 / 65536, abs=1e-3)


def test_plate_follows_a_steered_clock_by_few_changes() -> None:
    """Rates that differ by 1 ppm, every 50 ms: 0.6 us wrong at most by a change in two seconds."""
    chance = random.Random(1)
    clock = AmplifierClock(Crystal(error=50e-6, warm_up=1e-6), since=0.0)
    plate, changes, time = StraightClocks({"a": clock}, time=0.0), 0, 0.0
    for number in range(1, 2400):
        while (due := plate.next_due) < number / 20:
            changes += len(plate.renew(due))
            time = due
        time = number / 20
        assert abs(plate.straight["a"].at(time) - clock.straight(time).shown) < WRONG + 0.1e-6
        steady = -round(1e7 * (clock.crystal.pace(time) - 1))
        clock.steer(steady + chance.randrange(-10, 11), time)
        changes += len(plate.renew(time))
    assert changes < 60
