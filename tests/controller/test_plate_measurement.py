"""A rig's plate measured by its own ERAs over wires in virtual time, and identified by that."""

import asyncio
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from controller.plate_measurement import (
    MeasuredPlate,
    PlateSelfMeasurement,
    PlateSensor,
    TonePlayer,
    checked_level,
    interleaved,
)
from drivers.errors import CommandRefused
from drivers.host.amplifier_sensors import Reading, SensorReading, measure_tones
from drivers.opening import Lines
from kit.clock import run_virtual
from kit.direct_plate import direct_responder
from kit.wires import SHARED_WIRES, WIRES, FarSide, far_side, on_two_amplifiers
from model.answer.plan import query
from model.answer.stimulus import Placement
from model.errors import InputError
from model.estimate.forward import Sensor
from model.estimate.identify import identify
from model.rig.rig import Rig
from model.rig.rig_file import example_rig_path, load_rig
from model.structure.attachments import PointLoad
from model.table.table_file import build_table
from sim.bench import bench
from sim.far_ends.wire_assignment import SimulatedWire
from sim.plant.fingers import Accelerometer
from sim.sensors import Accelerometers

TONES = np.arange(60.0, 480.0, 35.0)
FINGERS = (
    ((0.08, 0.06), (0.22, 0.16)),
    ((0.25, 0.05), (0.06, 0.17)),
    ((0.15, 0.11), (0.04, 0.04)),
    ((0.05, 0.19), (0.24, 0.19)),
    ((0.20, 0.08), (0.10, 0.15)),
)

NOISE = 0.01  # m/s²/sqrt(Hz), of each foot: a thousandth of what it hears in a reading


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The paper's rig with weightless fingers."""
    return replace(load_rig(example_rig_path()), fingertip=None)


@pytest.fixture(scope="module")
def truth(rig: Rig) -> Rig:
    """The plate on the table: other springs, losses, thickness, gains, places, and 3 g on it."""
    changes = (
        (0.90, 1.04, -3, 1.2),
        (1.07, 0.95, 4, 0.4),
        (1.12, 1.0, 2, 0.9),
        (0.95, 0.97, -5, 0),
    )
    eras = tuple(
        replace(
            era,
            x=abs(era.x - inwards * 1e-3),
            stiffness=spring * era.stiffness,
            damping=1.3 * era.damping,
            gains=((110.0, gain, math.radians(phase)),),
        )
        for era, (spring, gain, phase, inwards) in zip(rig.eras, changes, strict=True)
    )
    plate = replace(rig.plate, thickness=1.015 * rig.plate.thickness, loss_factor=0.013)
    return replace(rig, plate=plate, eras=eras, masses=(PointLoad(0.11, 0.15, mass=3e-3),))


@pytest.fixture(autouse=True)
def noisy_feet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sensors at the feet of ERAs with noise."""
    quiet = bench._feet

    def noisy(rig: Rig, amplifier: str) -> list[Accelerometer]:
        return [replace(each, noise_density=NOISE) for each in quiet(rig, amplifier)]

    monkeypatch.setattr(bench, "_feet", noisy)


async def measured(
    rig: Rig,
    far: FarSide,
    *,
    is_quick: bool = True,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> MeasuredPlate:
    """Measure a rig at a far side; then all its amplifiers are silent and disarmed."""
    try:
        return await PlateSelfMeasurement(
            rig, Lines, far.urls, is_quick=is_quick, progress=progress
        ).run()
    finally:
        far.summary()
        for each in far.bench.amplifiers.values():
            assert each.state == "SWITCH_ON_DISABLED"
            assert not any(output for output in each.outputs)


@pytest.mark.parametrize(
    ("wire", "bound"),
    [
        pytest.param(SHARED_WIRES["can+socketcand"], 0.01, id="bus"),
        pytest.param(WIRES["serial"], 0.06, id="two wires", marks=pytest.mark.long),
        pytest.param(
            replace(WIRES["serial"], line_kind="ftdi-low-latency"),
            0.6,
            id="FTDI",
            marks=pytest.mark.long,
        ),
    ],
)
def test_two_amplifiers_hear_each_other_where_their_clocks_are_held(
    wire: SimulatedWire, bound: float, rig: Rig, truth: Rig
) -> None:
    """All responses as a direct solution; but for 3 us, 20 us, 200 us (0.6 rad) at 500 Hz.

    Clocks that turn repeated tones are no other level, and no plate that has changed.
    """

    async def run() -> MeasuredPlate:
        async with far_side(wire, on_two_amplifiers(truth)) as far:
            return await measured(on_two_amplifiers(rig), far)

    taken = run_virtual(run())
    measurement = taken.measurement
    measurement.check()
    assert taken.duration < 10
    assert len(measurement.frequencies) == 28
    assert (measurement.known.sum(axis=0) == 7).all()
    assert sorted(measurement.clock_errors) == sorted(on_two_amplifiers(rig).amplifiers)
    expected = direct_responder(truth.plate, truth.mesh)(
        truth.eras,
        measurement.frequencies,
        np.array([(era.x, era.y) for era in truth.eras]),
        loads=truth.masses,
    )
    strokes = np.array([era.stroke for era in truth.eras])
    number = {era.name: n for n, era in enumerate(rig.eras)}
    at = [number[sensor.era] for sensor in measurement.sensors]
    fields = (expected / strokes[:, None]).swapaxes(1, 2)[:, at]
    assert np.nanmax(abs(measurement.values - fields)) < bound * abs(fields).max()


@pytest.mark.parametrize("is_cancelled", [True, False])
def test_interrupted_measurement_ends_silent(is_cancelled: bool, rig: Rig, truth: Rig) -> None:
    """By Ctrl-C, as a cancelled task, or by an error of the caller; `measured` sees to silence."""

    async def run() -> None:
        async with far_side(WIRES["serial"], truth) as far:

            def interrupt(done: int, of: int) -> None:
                if done == 2 and not is_cancelled:
                    raise ZeroDivisionError
                if done == 2:
                    task.cancel()

            task = asyncio.create_task(measured(rig, far, progress=interrupt))
            with pytest.raises(asyncio.CancelledError if is_cancelled else ZeroDivisionError):
                await task

    run_virtual(run())


def test_overloaded_sensor_is_named(rig: Rig, truth: Rig) -> None:
    """One accelerometer beside the feet with a range of 1 mm/s²."""

    async def run() -> None:
        async with far_side(WIRES["serial"], truth) as far:
            Accelerometers(far.bench).place([Accelerometer("A", 0.1, 0.1, reach=1e-3)])
            await measured(rig, far)

    with pytest.raises(CommandRefused, match=r"sensor 4 of amplifier main.*--level"):
        run_virtual(run())


@pytest.mark.parametrize("derivatives", [0, 1, 2])
def test_velocity_and_displacement_become_acceleration(derivatives: int) -> None:
    """Of 0.1 mm at 100 Hz, read as m/s², m/s or m: 39.5 m/s², in antiphase to the displacement."""
    omega = 2 * math.pi * 100
    amplitude, phase = 1e-4 * omega ** (2 - derivatives), 90.0 * (2 - derivatives)
    heard = SensorReading(is_overloaded=False, tones=((amplitude, phase),))
    reading = Reading(1, "COMPLETE", 0.0, 0.0, 7, 1, (heard,))
    sensor = PlateSensor("main", 0, Sensor("SW", "SW"), derivatives, 1000.0)
    (found,) = sensor.accelerations(reading, np.array([100.0]))
    assert found == pytest.approx(-39.478, rel=1e-4)


def test_level_stays_10_db_below_what_the_rig_allows(rig: Rig) -> None:
    """Usual 0.1; less where limits are narrow; 0.4 of full stroke is refused."""
    assert checked_level(rig, None) == pytest.approx(0.1)
    narrow = replace(rig, limits=replace(rig.limits, level=0.2))
    assert checked_level(narrow, None) == pytest.approx(0.2 * 10**-0.5)
    for each, level in ((rig, 0.4), (narrow, 0.1), (rig, 0.0), (rig, math.nan)):
        with pytest.raises(InputError, match="--level"):
            checked_level(each, level)


async def contrasts(rig: Rig, far: FarSide, known: Rig) -> list[float]:
    """Contrast [dB] of a known rig's patterns at pairs of fingers, measured in time."""
    sensors = Accelerometers(far.bench)
    table = build_table(known, frequencies=TONES, drive_mode="phased")
    player = TonePlayer(rig, Lines, far.urls)
    found = []
    try:
        await player.open()
        (amplifier,) = player.amplifiers.values()
        await player.group.arm()
        for target, quiet in FINGERS:
            sensors.place([Accelerometer("T", *target), Accelerometer("Q", *quiet)])
            (layer,) = query(table, Placement((target,), (quiet,)), 35.0).layers
            plays = await player.play(layer.excitation)
            for _ in range(30):
                await asyncio.sleep(0.05)
                await player.group.beat()
            (frequency,) = {command.frequency for command in plays.values()}
            reading = await measure_tones(amplifier, [frequency], 0.1)
            await player.group.beat()
            one, other = (each.tones[0][0] for each in reading.sensors[-2:])
            found.append(20 * math.log10(one / other))
    finally:
        await player.close()
    return found


@pytest.mark.long
def test_identified_rig_is_the_truth_and_its_patterns_have_more_contrast(
    rig: Rig, truth: Rig
) -> None:
    """Parameters agree within three standard errors; contrast in time rises by 6 dB and more."""

    async def run() -> tuple[MeasuredPlate, list[float], Rig, list[float]]:
        async with far_side(WIRES["serial"], truth) as far:
            taken = await measured(rig, far)
            found = identify(rig, taken.measurement)
            assert found.is_explained
            space = found.fitted.space
            check(space.names, found.fitted.x * space.std, found.std)
            before = await contrasts(rig, far, rig)
            return taken, before, found.rig, await contrasts(rig, far, found.rig)

    def check(names: tuple[str, ...], x: np.ndarray, std: np.ndarray) -> None:
        found = dict(zip(names, zip(x, std, strict=True), strict=True))
        for era, real in zip(rig.eras, truth.eras, strict=True):
            for name, expected in (
                (f"stiffness {era.name}", math.log(real.stiffness / era.stiffness)),
                (f"gain {era.name}", math.log(real.gains[0][1])),
                (f"phase {era.name}", real.gains[0][2]),
                (f"x of {era.name}", real.x - era.x),
                ("mass 1", 3e-3),
                ("x of mass 1", 0.11 - rig.plate.length / 2),
                ("y of mass 1", 0.15 - rig.plate.width / 2),
            ):
                value, error = found[name]
                assert abs(value - expected) < 3 * error, name

    taken, before, _, after = run_virtual(run())
    assert taken.duration < 10
    assert np.median(after) > np.median(before) + 6


RANGE = (45.0, 480.0)  # Hz


def with_eras(rig: Rig, count: int) -> Rig:
    """A rig with more ERAs, or fewer, along its edges."""
    first = rig.eras[0]
    length, width = rig.plate.length, rig.plate.width
    eras = [
        replace(first, name=f"E{n}", x=length * (n % 2), y=width * n / (count - 1))
        for n in range(count)
    ]
    return replace(rig, eras=tuple(eras))


@pytest.mark.parametrize("count", [3, 4, 8, 20])
@pytest.mark.parametrize("is_quick", [True, False])
def test_every_era_has_a_frequency_of_its_own(count: int, is_quick: bool, coarse_rig: Rig) -> None:
    """Tones of a step are told apart by its window; a round plays each once, all rounds by all."""
    tones = interleaved(with_eras(coarse_rig, count), RANGE, is_quick=is_quick)
    played: dict[float, list[int]] = {}
    for step in tones.steps:
        frequencies = sorted(frequency for _, frequency in step)
        assert RANGE[0] <= frequencies[0] < frequencies[-1] <= RANGE[1]
        assert all((after - before) * tones.window > 1 for before, after in pairwise(frequencies))
        assert len(step) <= 16
        for era, frequency in step:
            played.setdefault(frequency, []).append(era)
    assert {era for eras in played.values() for era in eras} == {*range(count)}
    assert len(played) >= 16
    together = min(count, 16)
    for eras in played.values():
        assert len({*eras}) == len(eras)
        assert is_quick or len(eras) in {count % 16, together, count}


def test_whole_takes_at_most_forty_seconds_and_one_round_ten(coarse_rig: Rig) -> None:
    """Settling and windows of the paper's plate, with the two repeated steps."""
    for is_quick, limit in ((True, 10.0), (False, 40.0)):
        tones = interleaved(coarse_rig, RANGE, is_quick=is_quick)
        assert (len(tones.steps) + 2) * (tones.settling + tones.window + 0.07) < limit
