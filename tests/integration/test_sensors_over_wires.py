"""Tones at an amplifier's sensors, over every wire, against a direct solution in frequency."""

import asyncio
import math

import numpy as np
import pytest

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandError, CommandRefused, FrameError
from drivers.guard import Guard, GuardLimits
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.keep_alive import keep_alive
from drivers.protocol.messages import Feature, ReadingState, SensorUnit
from drivers.registry import open_backend
from long_form import shortly
from memory_machine import live_in_memory
from model.rig.rig import Rig
from model.vibration.direct import direct_responder
from rig_on_wire import FarSide, far_side
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.far_ends.can_bus.sensor_objects import SensorObjects
from sim.sensors.accelerometer import Accelerometer, Accelerometers
from virtual_loop import run_virtual
from wires import WIRES, patient

PLACE = (0.11, 0.07)  # m; of an accelerometer
PLAYED = (DriveCommand(1, 110.0, 0.2, 40.0), DriveCommand(3, 173.5, 0.3, -75.0))
SETTLING, WINDOW = 1.5, 0.4  # s


async def opened(far: FarSide) -> Amplifier:
    """Open the amplifier of a far side."""
    amplifier = Amplifier(open_backend(patient(far.url)))
    await amplifier.open()
    return amplifier


async def settled(amplifier: Amplifier, *commands: DriveCommand) -> CheckedAmplifier:
    """Play commands until the plate has settled."""
    checked = CheckedAmplifier(amplifier)
    await checked.arm(2.0)
    guard = Guard(GuardLimits(20.0, 600.0, 1.0), amplifier.capabilities)
    token = amplifier.next_token()
    await checked.apply(guard.check(CommandSet(token, commands, ramp=0.05, valid_for=0.0)))
    await keep_alive(checked, SETTLING, interval=0.05)
    return checked


@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "modbus+rtu", "can+slcan"]))
def test_tones_are_those_of_a_direct_solution(wire: str, coarse_rig: Rig) -> None:
    """Two tones at once on two ERAs, at every foot and an accelerometer: within 1 % and 1 degree.

    Small ones of 1 % of the largest and less, next to a nodal line, within 1 % of the largest.
    """

    async def run() -> tuple[np.ndarray, ReadingState]:
        live_in_memory()
        async with far_side(WIRES[wire], coarse_rig) as far:
            Accelerometers(far.bench).place([Accelerometer("A", *PLACE)])
            amplifier = await opened(far)
            await settled(amplifier, *PLAYED)
            reading = await amplifier.measure([one.frequency for one in PLAYED], WINDOW)
            status = await amplifier.status()
            await amplifier.disarm(0.0)
            await amplifier.close()
            phasors = [[tone.phasor for tone in one.tones] for one in reading.sensors]
            assert reading.token == status.token
            return np.array(phasors), reading.state

    phasors, state = run_virtual(run())
    assert state is ReadingState.COMPLETE
    by_channel = sorted(coarse_rig.eras, key=lambda era: coarse_rig.wiring[era.name].number)
    points = np.array([*((era.x, era.y) for era in by_channel), PLACE])
    solve = direct_responder(coarse_rig.plate, coarse_rig.mesh)
    frequencies = np.array([one.frequency for one in PLAYED])
    fields = solve(by_channel, frequencies, points)
    for tone, played in enumerate(PLAYED):
        drive = played.level * np.exp(1j * math.radians(played.phase))
        expected = fields[tone, played.channel] * drive
        seen = phasors[:, tone]
        assert abs(seen - expected).max() < 0.01 * abs(expected).max()
        large = abs(expected) > 0.01 * abs(expected).max()
        assert abs(abs(seen / expected)[large] - 1).max() < 0.01
        assert abs(np.angle(seen / expected, deg=True)[large]).max() < 1.0


def test_phases_count_from_the_commit(coarse_rig: Rig) -> None:
    """The phase of a later window is the same."""
    frequency = PLAYED[0].frequency

    async def run() -> list[complex]:
        live_in_memory()
        async with far_side(WIRES["serial"], coarse_rig) as far:
            amplifier = await opened(far)
            await settled(amplifier, PLAYED[0])
            found = []
            for _ in range(3):
                reading = await amplifier.measure([frequency], 0.1)
                found.append(reading.sensors[1].tones[0].phasor)
                await amplifier.heartbeat()
                await asyncio.sleep(0.0137)
            await amplifier.close()
            return found

    first, *others = run_virtual(run())
    assert all(abs(other / first - 1) < 0.01 for other in others)


@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "modbus+rtu", "can+slcan"]))
def test_sensors_are_described_and_many_tones_read(wire: str, coarse_rig: Rig) -> None:
    """Sixteen tones at five sensors take several replies; raw samples hold the same tone."""
    frequencies = [90.0 + 10 * n for n in range(16)]
    extra = Accelerometer("A", *PLACE, reach=1e-3)  # m/s²; overloaded

    async def run() -> None:
        live_in_memory()
        async with far_side(WIRES[wire], coarse_rig) as far:
            Accelerometers(far.bench).place([extra])
            amplifier = await opened(far)
            found = await amplifier.sensors()
            eras = {coarse_rig.wiring[era.name].number: era for era in coarse_rig.eras}
            assert [one.channel for one in found] == [*sorted(eras), None]
            for one, at in zip(
                found, [*((eras[n].x, eras[n].y) for n in sorted(eras)), PLACE], strict=True
            ):
                assert (one.x, one.y) == pytest.approx(at, abs=5e-5)
            assert {one.unit for one in found} == {SensorUnit.ACCELERATION}
            await settled(amplifier, DriveCommand(0, frequencies[2], 0.2))
            reading = await amplifier.measure(frequencies, 0.2)
            assert [one.is_overloaded for one in reading.sensors] == [False] * 4 + [True]
            assert all(len(one.tones) == 16 for one in reading.sensors)
            # 97 bytes each, 255 at most while a heartbeat waits.
            assert 1 <= len((await amplifier.reading()).sensors) <= 2
            tone = reading.sensors[0].tones[2]
            others = [tone.amplitude for one in reading.sensors[:4] for tone in one.tones]
            silent = [a for n, a in enumerate(others) if n % 16 != 2]
            assert max(silent) < 0.01 * tone.amplitude
            counts: list[int] = []
            while (block := await amplifier.raw_samples(0, len(counts))).samples:
                assert (block.number, block.first) == (reading.number, len(counts))
                counts += block.samples
                await amplifier.heartbeat()
            await amplifier.disarm(0.0)
            await amplifier.close()
            rate, step = found[0].sample_rate, found[0].count_step
            assert len(counts) == block.end == round(0.2 * rate)
            times = reading.start + np.arange(len(counts)) / rate
            angle = 2 * math.pi * frequencies[2] * times + math.radians(tone.phase)
            # A sample comes up to one period of the rate after its nominal time.
            late = 2 * math.pi * frequencies[2] / rate
            error = np.array(counts) * step - tone.amplitude * np.sin(angle)
            assert abs(error).max() < (late + 0.01) * tone.amplitude + step

    run_virtual(run())


@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "modbus+rtu", "can+slcan"]))
def test_measuring_is_refused_without_sensors(
    wire: str, coarse_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The feature says so before; a host that asks all the same is refused."""

    async def run() -> None:
        live_in_memory()
        async with far_side(WIRES[wire], coarse_rig) as far:
            amplifier = await opened(far)
            assert Feature.SENSORS not in amplifier.capabilities.features
            assert await amplifier.sensors() == ()
            with pytest.raises(CommandRefused, match="Measure"):
                await amplifier.measure([110.0], 0.1)
            await amplifier.close()

    monkeypatch.setattr(SimulatedAmplifier, "attach", lambda amplifier, sensing: None)
    run_virtual(run())


@pytest.mark.parametrize("name", ["_count", "_sensor", "_tones", "_reading", "_samples"])
def test_object_of_sensors_with_a_byte_too_many_is_an_error(
    name: str, coarse_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Objects over CAN end where their last field does."""

    async def run() -> None:
        live_in_memory()
        async with far_side(WIRES["can+socketcand"], coarse_rig) as far:
            amplifier = await opened(far)

            async def read() -> None:
                await amplifier.measure([110.0], 0.05)
                await amplifier.raw_samples(0)
                await amplifier.sensors()

            with pytest.raises(FrameError):
                await read()
            await amplifier.close()

    whole = getattr(SensorObjects, name)
    monkeypatch.setattr(SensorObjects, name, lambda *given: whole(*given) + b"\0")
    run_virtual(run())


@pytest.mark.parametrize("wire", shortly(WIRES, ["serial", "modbus+rtu", "can+slcan"]))
@pytest.mark.parametrize(("sensor", "sample"), [(32, 0), (-1, 0), (0, 1 << 32)])
def test_sensors_and_samples_out_of_range_are_not_sent(
    wire: str, sensor: int, sample: int, coarse_rig: Rig
) -> None:
    """A sensor is 0 to 31, a sample a number of 32 bits."""

    async def run() -> None:
        live_in_memory()
        async with far_side(WIRES[wire], coarse_rig) as far:
            amplifier = await opened(far)
            with pytest.raises(CommandError):
                await amplifier.raw_samples(sensor, sample)
            if sensor:
                with pytest.raises(CommandError):
                    await amplifier.reading(sensor)
            assert len(await amplifier.sensors()) == 4  # the link is as it was
            await amplifier.close()

    run_virtual(run())


@pytest.mark.parametrize("is_restarted", [False, True])
def test_reading_of_another_is_not_taken_for_its_own(is_restarted: bool, coarse_rig: Rig) -> None:
    """That of another host, or none after a loss of supply."""

    async def run() -> None:
        live_in_memory()
        async with far_side(WIRES["serial"], coarse_rig) as far:
            amplifier = await opened(far)
            started = await amplifier.start_reading([110.0], 0.05)
            if is_restarted:
                far.device.restart()
            else:
                await amplifier.start_reading([90.0], 0.05)
            with pytest.raises(CommandRefused, match="replaced"):
                await amplifier.finish_reading(started)
            is_none = (await amplifier.reading()).state is ReadingState.NONE
            assert is_none == is_restarted
            await amplifier.close()

    run_virtual(run())


@pytest.mark.parametrize(
    ("frequencies", "window"),
    [([], 0.1), ([100.0] * 17, 0.1), ([9.0], 0.1), ([100.0, 105.0], 0.1), ([100.0], math.nan)],
)
def test_tones_that_a_window_does_not_tell_apart_are_an_error(
    frequencies: list[float], window: float, coarse_rig: Rig
) -> None:
    """Before anything is sent."""

    async def run() -> None:
        live_in_memory()
        async with far_side(WIRES["serial"], coarse_rig) as far:
            amplifier = await opened(far)
            before = amplifier.statistics.frames_out
            with pytest.raises(CommandError):
                await amplifier.measure(frequencies, window)
            assert amplifier.statistics.frames_out == before
            await amplifier.close()

    run_virtual(run())
