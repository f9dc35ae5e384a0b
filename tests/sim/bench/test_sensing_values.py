"""Sensors of amplifiers of protocol 4: what they measure, what disturbs, what is refused."""

import cmath
import math

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from drivers.host.amplifier import measure_tones, read_sensors
from drivers.protocol.definition import READING_STATES
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Command, LayerSet, pack_layers, parts
from model.fem import assemble
from model.rig.rig import Rig
from plates import apart
from real_wires import WIRES, layer, on_two_amplifiers, rig_on_wire
from registry import threads
from sim.bench.bench import Bench
from sim.plant.fingers import Accelerometer
from virtual_lines import in_virtual_time

SESSION = 9


def bench_of(rig: Rig) -> Bench:
    """A bench whose amplifiers are armed at 5 s, for 2 s at a time."""
    bench = Bench(rig, now=5.0)
    for name in bench.amplifiers:
        bench.exchange(name, "Arm", {"session": SESSION, "watchdog": 2000, "shift": 0}, now=5.0)
    return bench


def play(bench: Bench, token: int, *layers: LayerSet, now: float) -> None:
    """Play layers on the amplifier main."""
    for part in parts(pack_layers(layers), session=SESSION, token=token, now=True):
        bench.exchange("main", "Set", part, now=now)


def measure(bench: Bench, number: int, *frequencies: float, now: float, window: int) -> Values:
    """Begin a reading over a window [ms]."""
    tones = [round(20 * each) for each in frequencies]
    values = {"reading": number, "window": window, "tones": len(tones), "frequencies": tones}
    found: Values = bench.exchange("main", "Measure", values, now=now)
    return found


def reading(bench: Bench, now: float, name: str = "main") -> Values:
    """The reading at a time [s]."""
    found: Values = bench.exchange(name, "GetReading", {"first": 0}, now=now)
    return found


@in_virtual_time
async def test_host_measures_at_the_feet_what_the_model_says(coarse_rig: Rig) -> None:
    """Amplitude and phase of two tones at four feet and at 28 places more, two a reply: 2 %.

    Against the sparse direct solve; phases count on the clock, whenever the set was committed.
    """
    frequencies = [110.0 + 20 * number for number in range(16)]
    x = np.linspace(0.02, 0.28, 28)
    async with rig_on_wire(coarse_rig, WIRES["serial"]) as rig:
        rig.bench.place_sensors([Accelerometer("", each, 0.11) for each in x])
        await rig.group.arm()
        tones = [layer((0, 110.0, 1.0)), layer((3, 210.0, 0.5), number=1)]
        await rig.group.apply({"main": tones})
        await rig.beat_until(threads.now() + 4.0)
        main = rig.group.amplifiers["main"]
        sensors = await read_sensors(main)
        found = await measure_tones(main, frequencies, 0.2)
    assert [each.channel for each in sensors[:5]] == [0, 1, 2, 3, None]
    assert (len(sensors), len(found.sensors), found.state) == (32, 32, "COMPLETE")
    points = np.array([[each.x, each.y] for each in sensors], dtype=float)
    unit = direct_acceleration(
        assemble(coarse_rig.plate, coarse_rig.mesh),
        coarse_rig.eras,
        np.array([110.0, 210.0]),
        points,
    )
    for index, expected in ((0, unit[0, 0]), (5, 0.5 * unit[1, 3])):
        measured = [
            cmath.rect(one.tones[index][0], math.radians(one.tones[index][1]))
            for one in found.sensors
        ]
        assert apart(np.array(measured), expected) < 0.02


def test_what_changes_disturbs_a_reading_and_a_renewal_does_not(coarse_rig: Rig) -> None:
    """A renewal amid the window, a set, the end of `valid_for`; after the window nothing does."""
    tone = LayerSet(0, 0, 300, (Command(0, 2200, 1000, 0),))
    renewal = LayerSet(0, 0, 300, renew=True)
    for number, (what, state) in enumerate(
        [((renewal,), "COMPLETE"), ((tone,), "DISTURBED"), ((), "DISTURBED")], 1
    ):
        bench = bench_of(coarse_rig)
        play(bench, 1, tone, now=5.1)
        measure(bench, number, 110.0, now=5.2, window=300 if not what else 100)
        if what:
            play(bench, 2, *what, now=5.25)
        found = reading(bench, 5.6)
        assert READING_STATES[state] == found["state"]
        # 5.2 s of the 20 s in which 2^32 steps go round.
        assert (found["reading"], found["token"]) == (number, 1)
        assert found["window_start"] == round(5.2 / 20 * 2**32)
        bench.exchange("main", "Stop", {"ramp": 0}, now=5.7)
        assert reading(bench, 5.8)["state"] == found["state"]


def test_reading_without_a_set_has_no_token(coarse_rig: Rig) -> None:
    """After arming no token is there, whatever was played before."""
    bench = bench_of(coarse_rig)
    play(bench, 7, LayerSet(0, 0, 0, (Command(0, 2200, 1000, 0),)), now=5.1)
    bench.exchange("main", "Disarm", {"ramp": 0}, now=5.2)
    bench.exchange("main", "Arm", {"session": SESSION + 1, "watchdog": 2000, "shift": 0}, now=5.3)
    found = measure(bench, 1, 110.0, now=5.4, window=100)
    assert found["token"] == 0
    bench.amplifiers["main"].restart(5.45)
    assert reading(bench, 5.6) == {
        **dict.fromkeys(("reading", "state", "window_left", "window_start", "token"), 0),
        **{"tones": 0, "count": 0, "sensors": []},
    }


def test_repeated_measure_goes_on_with_its_window(coarse_rig: Rig) -> None:
    """Its reply was lost; another number begins anew, and a refused one changes nothing."""
    bench = bench_of(coarse_rig)
    for now, number, left in ((5.0, 3, 100), (5.04, 3, 60), (5.06, 4, 100)):
        found = measure(bench, number, 110.0, now=now, window=100)
        assert (found["reading"], found["window_left"]) == (number, left)
    for frequencies in ((3000.05,), (9.0,), (110.0, 119.0), ()):
        with pytest.raises(Refusal) as caught:
            measure(bench, 5, *frequencies, now=5.08, window=100)
        assert caught.value.code == "BAD_VALUE"
    assert (reading(bench, 5.1)["reading"], reading(bench, 5.1)["window_left"]) == (4, 60)


def test_each_amplifier_has_the_sensors_of_its_own_eras(coarse_rig: Rig) -> None:
    """By the wiring; a reading of one is none of the other's."""
    bench = bench_of(on_two_amplifiers(coarse_rig))
    places = []
    for name in ("east", "west"):
        found = bench.exchange(name, "GetSensors", {"first": 0}, now=5.0)
        assert [one["channel"] for one in found["sensors"]] == [0, 1]
        assert (found["all"], found["count"]) == (2, 2)
        places += [(one["x"], one["y"]) for one in found["sensors"]]
    eras = sorted((round(1e4 * era.x), round(1e4 * era.y)) for era in coarse_rig.eras)
    assert sorted(places) == eras
    values = {"reading": 1, "window": 100, "tones": 1, "frequencies": [2200]}
    bench.exchange("east", "Measure", values, now=5.0)
    assert reading(bench, 5.0, "west")["reading"] == 0
