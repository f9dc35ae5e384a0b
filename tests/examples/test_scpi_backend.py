"""The example backend of a signal generator, against an instrument by its standard and manual."""

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace
from importlib import util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from controller.group.guards import check_watchdogs
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandError, CommandRefused, LinkError
from drivers.guard import Guard
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.protocol.classes import AmplifierClass, amplifier_class, missing
from drivers.protocol.messages import AmplifierState
from drivers.voltage import VoltageBackend
from model.rig.file import load_rig
from registry.limits import GuardLimits
from registry.voltage import Law, VoltageDrive
from scpi_generator import Generator, on_tcp, on_terminal
from voltage_rigs import moved, resonator

MODULE = Path(__file__).parents[2] / "examples" / "plugins" / "scpi" / "scpi_backend.py"
LIMITS = GuardLimits(frequency_min=60.0, frequency_max=240.0, level=1.0)
RESONANCES, GAIN = (140.0, 165.0), 8.0


@pytest.fixture(scope="module")
def example() -> ModuleType:
    """The module of the example."""
    spec = util.spec_from_file_location("scpi_backend", MODULE)
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def drives(bias: float = 0.0) -> dict[int, VoltageDrive]:
    """Two resonant actuators of quadratic law."""
    frequencies = np.arange(20.0, 1001.0, 1.0)
    made = {}
    for channel, resonance in enumerate(RESONANCES):
        found = resonator(frequencies, resonance, GAIN)
        rows = zip(frequencies, np.abs(found), np.angle(found), strict=True)
        response = tuple((float(f), float(size), float(phase)) for f, size, phase in rows)
        made[channel] = VoltageDrive(
            response,
            law=Law.QUADRATIC,
            bias=bias,
            minimum=-1.0 if bias else 0.0,
            frequencies=(60.0, 240.0),
        )
    return made


@asynccontextmanager
async def opened(
    example: ModuleType, generator: Generator, wire: str = "tcp", *, bias: float = 0.0
) -> AsyncIterator[Amplifier]:
    """An amplifier over a wire to a generator, converted, armed."""
    serve = on_tcp(generator) if wire == "tcp" else on_terminal(generator)
    async with serve as at:
        url = f"scpi://127.0.0.1:{at}" if wire == "tcp" else f"scpi+serial://{at}"
        backend = example.ScpiBackend(f"{url}?bias={bias}")
        amplifier = Amplifier(VoltageBackend(backend, drives(bias)))
        await amplifier.open()
        try:
            yield amplifier
        finally:
            await amplifier.close()


def a_set(amplifier: Amplifier, *commands: DriveCommand) -> CommandSet:
    """A set without a ramp."""
    return CommandSet(amplifier.next_token(), commands, ramp=0.0, valid_for=0.0)


TONES = (DriveCommand(0, 120.0, 0.5, 30.0), DriveCommand(1, 120.0, 0.25, -110.0))


@pytest.mark.parametrize(
    ("wire", "bias"), [("tcp", 0.0), ("serial", 0.0), ("tcp", 0.3), ("serial", 0.3)]
)
async def test_generator_moves_two_actuators_in_phase(
    example: ModuleType, wire: str, bias: float
) -> None:
    """Samples of its two voltages, squared, move two resonators as commanded, over each wire."""
    generator = Generator()
    async with opened(example, generator, wire, bias=bias) as amplifier:
        checked = CheckedAmplifier(amplifier)
        await checked.arm()
        guard = Guard(LIMITS, amplifier.capabilities)
        await checked.apply(guard.check(a_set(amplifier, *TONES)))
        status = await checked.heartbeat()
        assert status is not None
        assert status.levels == pytest.approx((0.5, 0.25), abs=2e-3)
        start = generator.outputs[0].origin
        assert generator.outputs[1].origin == start
        times = start + np.arange(0, 0.75, 1 / 20_000)
        for command, resonance in zip(TONES, RESONANCES, strict=True):
            share = generator.voltage(command.channel + 1, times) / 5.0  # full_voltage
            base = moved(share**2, times, resonance, GAIN)
            late = times > start + 0.5
            angle = 2 * np.pi * 120.0 * (times[late] - start)
            parts = [np.sin(angle), np.cos(angle), np.sin(2 * angle), np.cos(2 * angle)]
            basis = np.stack([*parts, np.ones_like(angle)], axis=1)
            sine, cosine, *_ = np.linalg.lstsq(basis, base[late], rcond=None)[0]
            wanted = command.level * np.exp(1j * math.radians(command.phase))
            assert abs(sine + 1j * cosine - wanted) < 2e-3
        await amplifier.disarm()
        assert not any(output.is_on for output in generator.outputs)
    assert not generator.errors


async def test_generator_is_of_class_c_and_says_what_it_lacks(example: ModuleType) -> None:
    """It identifies itself by *IDN?; no watchdog: only supervised is it driven."""
    async with opened(example, Generator()) as amplifier:
        identity = amplifier.identity
        assert (identity.product, identity.serial_number) == ("33522B", "MY52800123")
        can = amplifier.capabilities
        assert amplifier_class(can) is AmplifierClass.C
        assert [lack.name for lack in missing(can)] == [
            *(
                "watchdog",
                "staging",
                "envelopes",
                "ramps",
                "cross-fades",
                "valid_for",
                "broadcast",
                "8 voices",
            )
        ]
        assert can.level_max == 1.0
        with pytest.raises(CommandError, match="watchdog"):
            check_watchdogs({"main": amplifier})


async def test_opening_changes_nothing_but_silence(example: ModuleType) -> None:
    """An opening that only looks leaves a playing generator as it is; others switch it off."""
    generator = Generator()
    generator.outputs[0].is_on = True
    async with on_tcp(generator) as port:
        url = f"scpi://127.0.0.1:{port}"
        amplifier = Amplifier(VoltageBackend(example.ScpiBackend(url), drives()))
        await amplifier.open(take_over=False)
        assert (await amplifier.status()).levels[0] > 0
        await amplifier.close()
        assert generator.outputs[0].is_on
        await amplifier.open()
        assert not generator.outputs[0].is_on
        await amplifier.close()


async def test_stop_is_confirmed_by_reading_back(example: ModuleType) -> None:
    """Outputs off are a confirmed stop; an output that stays on is not one."""
    generator = Generator()
    async with opened(example, generator) as amplifier:
        await amplifier.arm()
        guard = Guard(LIMITS, amplifier.capabilities)
        await amplifier.apply(guard.check(a_set(amplifier, *TONES)))
        status = await amplifier.stop()
        assert status.state is AmplifierState.QUICK_STOP_ACTIVE
        assert status.levels == (0.0, 0.0)
        with pytest.raises(CommandRefused):
            await amplifier.arm()
        await amplifier.clear(status.latch)
        await amplifier.arm()
        generator.stuck_on = True
        await amplifier.apply(guard.check(a_set(amplifier, *TONES)))
        assert min((await amplifier.stop()).levels) > 0


async def test_error_of_the_generator_silences_it(example: ModuleType) -> None:
    """A voltage beyond what its output gives is queued as an error: refused, and silent."""
    generator = Generator()
    async with opened(example, generator) as amplifier:
        await amplifier.arm()
        guard = Guard(LIMITS, amplifier.capabilities)
        generator.outputs[1].offset = 4.9  # leaves 0.4 V of amplitude into an open circuit
        with pytest.raises(CommandRefused, match="-222"):
            await amplifier.apply(guard.check(a_set(amplifier, *TONES)))
        assert not any(output.is_on for output in generator.outputs)
        assert not generator.errors


async def test_tones_continue_or_start_from_silence(example: ModuleType) -> None:
    """Another level continues without a new start; another frequency needs silence before."""
    generator = Generator()
    async with opened(example, generator) as amplifier:
        await amplifier.arm()
        guard = Guard(LIMITS, amplifier.capabilities)
        await amplifier.apply(guard.check(a_set(amplifier, *TONES)))
        start = generator.outputs[0].origin
        louder = [replace(one, level=2 * one.level, keep_phase=True) for one in TONES]
        await amplifier.apply(guard.check(a_set(amplifier, *louder)))
        assert generator.outputs[0].origin == start
        other = replace(TONES[0], frequency=180.0)
        with pytest.raises(CommandRefused, match="cross-fade"):
            guard.check(a_set(amplifier, other))
        await amplifier.apply(guard.silence(amplifier.next_token(), (0, 1), ramp=0.02))
        assert not any(output.is_on for output in generator.outputs)
        await amplifier.apply(guard.check(a_set(amplifier, other)))
        assert generator.outputs[0].frequency == 90.0
        assert not generator.outputs[1].is_on


async def test_tone_that_continues_is_not_restarted_by_one_that_begins(
    example: ModuleType,
) -> None:
    """Another channel begins beside it; Achieved says that its time is not of the commit."""
    generator = Generator()
    async with opened(example, generator) as amplifier:
        await amplifier.arm()
        guard = Guard(LIMITS, amplifier.capabilities)
        first, second = TONES[0], replace(TONES[1], frequency=150.0)
        kept = replace(first, keep_phase=True)
        achieved = await amplifier.apply(guard.check(a_set(amplifier, first)))
        assert [one.keep_phase for one in achieved.commands] == [False]
        start = generator.outputs[0].origin
        achieved = await amplifier.apply(guard.check(a_set(amplifier, kept, second)))
        assert generator.outputs[0].origin == start
        assert [output.is_on for output in generator.outputs] == [True, True]
        assert generator.outputs[1].frequency == 75.0
        assert [one.keep_phase for one in achieved.commands] == [True, True]
        await amplifier.apply(guard.silence(amplifier.next_token(), (0, 1), ramp=0.0))
        achieved = await amplifier.apply(guard.check(a_set(amplifier, kept)))  # nothing continues
        assert generator.outputs[0].origin > start
        assert [one.keep_phase for one in achieved.commands] == [False]


async def test_late_reply_is_not_taken_for_another(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A reply after its time is discarded by its number."""
    generator = Generator()
    answer, held = generator.message, []

    def late(text: str) -> str | None:
        reply = answer(text)
        if not held:
            held.append(reply)
            return None
        return f"{held[0]}\n{reply}" if len(held) == 1 and not held.append(reply) else reply

    async with opened(example, generator) as amplifier:
        monkeypatch.setattr("drivers.backends.foreign_amplifier.REPLY_TIME", 0.05)
        generator.message = late  # type: ignore[method-assign]
        backend = amplifier._link.backend
        before = backend.counters.unexpected_frames
        status = await amplifier.status()
        assert status.levels == (0.0, 0.0)
        assert backend.counters.unexpected_frames == before + 1


@pytest.mark.parametrize("damaged", ["7;x;1;0;1", "\xff\xfe", ";;;;", "1;1;1"])
async def test_damaged_reply_is_counted_and_asked_for_again(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, damaged: str
) -> None:
    """Letters for numbers, no text, too few or empty answers; the next reply is understood."""
    generator = Generator()
    answer, broken = generator.message, []

    def once(text: str) -> str | None:
        reply = answer(text)
        if broken:
            return reply
        broken.append(text)
        number = str(reply).partition(";")[0]
        return damaged.replace("7;", f"{number};").encode("ascii", "replace").decode()

    async with opened(example, generator) as amplifier:
        monkeypatch.setattr("drivers.backends.foreign_amplifier.REPLY_TIME", 0.05)
        before = amplifier.statistics
        generator.message = once  # type: ignore[method-assign]
        assert (await amplifier.status()).levels == (0.0, 0.0)
        after = amplifier.statistics
        wrong = after.invalid_frames + after.unexpected_frames
        assert wrong == before.invalid_frames + before.unexpected_frames + 1


@pytest.mark.parametrize(
    "url",
    [
        *("scpi://", "scpi:///dev/ttyS0", "scpi+serial://host", "scpi://h:x", "scpi://h?volts=3"),
        *("scpi://h?full_voltage=11", "scpi://h?bias=1", "scpi://h?full_voltage=nan"),
    ],
)
def test_invalid_urls_are_refused(example: ModuleType, url: str) -> None:
    """Without a place, with unknown options, or beyond the generator's voltage."""
    with pytest.raises(CommandError):
        example.ScpiBackend(url)


async def test_generator_that_hangs_up_is_lost(example: ModuleType) -> None:
    """A closed connection is a loss; a port without a generator cannot be opened."""
    with pytest.raises(LinkError):
        await Amplifier(example.ScpiBackend("scpi://127.0.0.1:9")).open()
    server = await asyncio.start_server(lambda _, writer: writer.close(), "127.0.0.1", 0)
    async with server:
        backend = example.ScpiBackend(f"scpi://127.0.0.1:{server.sockets[0].getsockname()[1]}")
        causes: asyncio.Queue[str] = asyncio.Queue()
        backend.listen(lambda _: None, causes.put_nowait)
        await backend.open()
        assert await asyncio.wait_for(causes.get(), 5.0)
        await backend.close()


def test_rows_of_the_rig_are_close_enough() -> None:
    """Between its rows the example's response is within 2.5 % of the resonator's."""
    rig = load_rig(MODULE.with_name("rig.yaml"), mesh="16x12")
    frequencies = np.arange(60.0, 240.5, 0.5)
    for name, resonance in zip(("SW", "NE"), RESONANCES, strict=True):
        found = np.array([rig.voltage[name].at(f) for f in frequencies])
        wanted = resonator(frequencies, resonance, GAIN)
        np.testing.assert_allclose(found / wanted, 1.0, atol=0.025)
        assert rig.voltage[name].static == GAIN
