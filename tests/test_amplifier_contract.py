"""One contract, run over every backend: what any amplifier must do, whatever its wire."""

import asyncio
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import drivers
from drivers.amplifier import Amplifier
from drivers.backend import Backend
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommand
from drivers.protocol.messages import Fault, State, Status
from drivers.registry import open_backend

PAPER_PLATE = Path(drivers.__file__).parent.parent / "examples" / "paper_plate.yaml"
REPLY_TIMEOUT = 2.0  # s; on a busy machine a far end may be late, and is not wrong for it
CALM = 2.0  # s; a watchdog that does not trip while a test goes on


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's rig on a coarse mesh: the plate takes no part in this contract."""
    text = PAPER_PLATE.read_text(encoding="utf-8")
    assert "mesh: auto" in text
    path = tmp_path_factory.mktemp("rig") / "coarse.yaml"
    path.write_text(text.replace("mesh: auto", "mesh: 12x9"), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def serial_url(rig: Path) -> Iterator[str]:
    """The far end of a serial line as a process of its own."""
    with subprocess.Popen(
        [sys.executable, "-P", "-m", "sim", str(rig), "--serial"],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        name, _, url = process.stdout.readline().strip().partition(": ")
        assert name == "main"
        yield url
        process.terminate()


@pytest.fixture(params=["sim", "serial"])
def url(request: pytest.FixtureRequest, rig: Path) -> str:
    """An amplifier of the paper's rig behind each kind of wire."""
    return f"sim://{rig}" if request.param == "sim" else request.getfixturevalue("serial_url")


@pytest.fixture
async def backend(url: str) -> Backend:
    """The backend for that wire, not yet open."""
    return open_backend(url)


@pytest.fixture
async def amplifier(backend: Backend) -> AsyncIterator[Amplifier]:
    """An open amplifier, disarmed and without faults before and after."""
    amplifier = Amplifier(backend, reply_timeout=REPLY_TIMEOUT)
    await amplifier.open()
    yield amplifier
    await amplifier.stop(0.0)
    await amplifier.clear()
    await amplifier.close()


def guard_of(amplifier: Amplifier, *, channels: int | None = None) -> Guard:
    """A guard as the amplifier asks for, or one that takes it for larger than it is."""
    capabilities = amplifier.capabilities
    if channels is not None:
        capabilities = replace(capabilities, channels=channels)
    return Guard(GuardLimits(10.0, 600.0, 1.0), capabilities)


def tones(
    amplifier: Amplifier, levels: dict[int, float], *, token: int | None = None, **changes: float
) -> SafeCommand:
    """A guarded set at 110 Hz without a ramp, a level per channel."""
    wanted = CommandSet(
        token=amplifier.next_token() if token is None else token,
        commands=tuple(DriveCommand(channel, 110.0, level) for channel, level in levels.items()),
        ramp=changes.get("ramp", 0.0),
        valid_for=changes.get("valid_for", 0.0),
    )
    return guard_of(amplifier, channels=changes.get("channels")).check(wanted)


async def poll(ask: Callable[[], Awaitable[Status]], until: Callable[[Status], bool]) -> Status:
    """Ask again and again until the status is as wanted."""
    async with asyncio.timeout(10):
        while True:
            status = await ask()
            if until(status):
                return status
            await asyncio.sleep(0.005)


async def test_it_says_who_it_is_and_what_it_can(amplifier: Amplifier) -> None:
    """Identity is not empty, and the capabilities can be lived with."""
    identity, capabilities = amplifier.identity, amplifier.capabilities
    assert identity.vendor
    assert identity.serial_number
    assert identity.protocol_version == 1
    assert capabilities.channels == 4  # as wired in the rig
    assert 0 < capabilities.frequency_min < capabilities.frequency_max
    assert 0 < capabilities.level_max <= 1
    assert capabilities.watchdog_min <= 0.25 <= capabilities.watchdog_max


async def test_it_starts_disarmed(amplifier: Amplifier) -> None:
    """After opening, the high voltage is off and every channel silent."""
    status = await amplifier.status()
    assert status.state is State.SWITCH_ON_DISABLED
    assert not status.high_voltage
    assert status.levels == (0.0,) * 4


async def test_disarmed_it_plays_nothing(amplifier: Amplifier) -> None:
    """An apply before arming is refused, and arming afterwards brings nothing of it."""
    with pytest.raises(CommandRefused, match="not armed"):
        await amplifier.apply(tones(amplifier, {0: 0.5}))
    status = await amplifier.arm(CALM)
    assert status.state is State.OPERATION_ENABLED
    assert (status.token, status.levels) == (0, (0.0,) * 4)
    assert status.high_voltage


async def test_it_says_what_it_really_plays(amplifier: Amplifier) -> None:
    """What is achieved is what was asked to the nearest step; token and levels read back."""
    await amplifier.arm(CALM)
    wanted = CommandSet(
        token=amplifier.next_token(),
        commands=(
            DriveCommand(0, 123.456789, 0.333333, 12.3456),
            DriveCommand(2, 60.0, 1.0, 270.0),
        ),
        ramp=0.0,
        valid_for=0.0,
    )
    achieved = await amplifier.apply(guard_of(amplifier).check(wanted))
    step = amplifier.capabilities
    assert achieved.token == wanted.token
    assert [command.channel for command in achieved.commands] == [0, 2]
    for command, asked in zip(achieved.commands, wanted.commands, strict=True):
        assert abs(command.frequency - asked.frequency) <= step.frequency_step / 2 + 1e-9
        assert abs(command.level - asked.level) <= step.level_step / 2 + 1e-9
        turned = (command.phase - asked.phase + 180) % 360 - 180
        assert abs(turned) <= step.phase_step / 2 + 1e-9
    assert achieved.commands[0].frequency == pytest.approx(123.46, abs=1e-9)
    status = await amplifier.status()
    assert status.token == wanted.token
    assert status.levels == pytest.approx((0.3333, 0.0, 1.0, 0.0), abs=1e-4)


async def test_channels_that_are_not_named_fall_silent(amplifier: Amplifier) -> None:
    """A set says everything: what it does not name stops."""
    await amplifier.arm(CALM)
    await amplifier.apply(tones(amplifier, {0: 0.5, 1: 0.5}))
    await amplifier.apply(tones(amplifier, {1: 0.25}))
    assert (await amplifier.status()).levels == pytest.approx((0.0, 0.25, 0.0, 0.0), abs=1e-4)


async def test_a_set_is_taken_whole_or_not_at_all(amplifier: Amplifier) -> None:
    """One channel that does not exist refuses the set; what played before plays on."""
    await amplifier.arm(CALM)
    before = tones(amplifier, {0: 0.5})
    await amplifier.apply(before)
    with pytest.raises(CommandRefused, match="no such channel") as caught:
        await amplifier.apply(tones(amplifier, {1: 0.7, 9: 0.1}, channels=16))
    assert caught.value.channel == 9
    status = await amplifier.status()
    assert status.token == before.token
    assert status.levels == pytest.approx((0.5, 0.0, 0.0, 0.0), abs=1e-4)


async def test_a_token_is_applied_once(amplifier: Amplifier) -> None:
    """A set under a token that plays already changes nothing, and the answer tells what plays."""
    await amplifier.arm(CALM)
    first = tones(amplifier, {0: 0.5})
    played = await amplifier.apply(first)
    assert await amplifier.apply(first) == played
    assert await amplifier.apply(tones(amplifier, {1: 0.9}, token=first.token)) == played
    assert await amplifier.commit(first.token) == played
    assert (await amplifier.status()).levels == pytest.approx((0.5, 0.0, 0.0, 0.0), abs=1e-4)


async def test_stage_moves_nothing_and_commit_does(amplifier: Amplifier) -> None:
    """A staged set waits for its commit; the commit answers as an apply would."""
    await amplifier.arm(CALM)
    staged = tones(amplifier, {3: 0.4})
    promised = await amplifier.stage(staged)
    status = await amplifier.status()
    assert (status.token, status.levels) == (0, (0.0,) * 4)
    assert await amplifier.commit(staged.token) == promised
    status = await amplifier.status()
    assert status.token == staged.token
    assert status.levels == pytest.approx((0.0, 0.0, 0.0, 0.4), abs=1e-4)


async def test_an_unknown_token_is_not_committed(amplifier: Amplifier) -> None:
    """A commit of what was never staged is refused and changes nothing."""
    await amplifier.arm(CALM)
    await amplifier.stage(tones(amplifier, {3: 0.4}, token=77))
    with pytest.raises(CommandRefused, match="token"):
        await amplifier.commit(78)
    assert (await amplifier.status()).levels == (0.0,) * 4


async def test_a_stop_is_latched_until_cleared(amplifier: Amplifier) -> None:
    """After a stop nothing plays and nothing arms; clearing leads to disarmed, not to playing."""
    await amplifier.arm(CALM)
    await amplifier.apply(tones(amplifier, {0: 0.5}))
    status = await amplifier.stop(0.0)
    assert status.state is State.QUICK_STOP_ACTIVE
    assert status.levels == (0.0,) * 4
    for call in (amplifier.arm(CALM), amplifier.apply(tones(amplifier, {0: 0.5}))):
        with pytest.raises(CommandRefused):
            await call
    status = await amplifier.clear()
    assert status.state is State.SWITCH_ON_DISABLED
    assert not status.high_voltage
    status = await amplifier.arm(CALM)
    assert (status.token, status.levels) == (0, (0.0,) * 4)


async def test_disarming_is_silent(amplifier: Amplifier) -> None:
    """Disarm ends the vibration along its ramp, then the high voltage."""
    await amplifier.arm(CALM)
    await amplifier.apply(tones(amplifier, {0: 0.5}))
    await amplifier.disarm(0.01)
    status = await poll(amplifier.status, lambda status: status.state is State.SWITCH_ON_DISABLED)
    assert status.levels == (0.0,) * 4
    assert not status.high_voltage
    with pytest.raises(CommandRefused):
        await amplifier.apply(tones(amplifier, {0: 0.5}))


async def test_the_watchdog_silences_and_latches(amplifier: Amplifier) -> None:
    """Without a heartbeat the vibration ends in a fault; asking for the status is no heartbeat."""
    await amplifier.arm(amplifier.capabilities.watchdog_min)
    await amplifier.apply(tones(amplifier, {0: 0.5}))
    status = await poll(amplifier.status, lambda status: status.state is State.FAULT)
    assert status.fault is Fault.WATCHDOG
    assert status.levels == (0.0,) * 4
    assert not status.high_voltage
    assert (await amplifier.faults())[0].fault is Fault.WATCHDOG
    await amplifier.heartbeat()
    for call in (amplifier.arm(CALM), amplifier.apply(tones(amplifier, {0: 0.5}))):
        with pytest.raises(CommandRefused):
            await call
    assert (await amplifier.clear()).state is State.SWITCH_ON_DISABLED


async def test_heartbeats_keep_it_playing(amplifier: Amplifier) -> None:
    """Each heartbeat fills the watchdog; between them it runs down."""
    await amplifier.arm(CALM)
    await amplifier.apply(tones(amplifier, {0: 0.5}))
    drained = await poll(amplifier.status, lambda status: status.watchdog_left < CALM - 0.02)
    status = await amplifier.heartbeat()
    assert drained.watchdog_left < status.watchdog_left <= CALM
    assert status.levels[0] == pytest.approx(0.5, abs=1e-4)


async def test_a_vibration_ends_by_itself(amplifier: Amplifier) -> None:
    """With valid_for the set falls silent without being told, and the amplifier stays armed."""
    await amplifier.arm(CALM)
    await amplifier.apply(tones(amplifier, {0: 0.5}, valid_for=0.03))
    status = await poll(amplifier.heartbeat, lambda status: not any(status.levels))
    assert status.state is State.OPERATION_ENABLED


async def test_a_lost_host_may_come_back(backend: Backend) -> None:
    """The same wire can be opened, used, closed and opened again."""
    for _ in range(2):
        amplifier = Amplifier(backend, reply_timeout=REPLY_TIMEOUT)
        await amplifier.open()
        assert (await amplifier.arm(CALM)).state is State.OPERATION_ENABLED
        await amplifier.disarm(0.0)
        await amplifier.close()


async def test_a_late_copy_of_a_set_changes_nothing(amplifier: Amplifier) -> None:
    """A set that was played before is refused, and what is staged meanwhile is not lost by it."""
    await amplifier.arm(CALM)
    old = tones(amplifier, {0: 0.5})
    await amplifier.apply(old)
    await amplifier.apply(tones(amplifier, {0: 0.2}))
    staged = tones(amplifier, {1: 0.4})
    await amplifier.stage(staged)
    with pytest.raises(CommandRefused, match="token"):
        await amplifier.apply(old)
    await amplifier.commit(staged.token)
    assert (await amplifier.status()).levels == pytest.approx((0.0, 0.4, 0.0, 0.0), abs=1e-4)


async def test_whoever_loses_patience_leaves_the_wire_usable(amplifier: Amplifier) -> None:
    """After a request that was cancelled, the next one gets its own reply."""
    for _ in range(3):
        asking = asyncio.create_task(amplifier.faults())
        await asyncio.sleep(0)
        asking.cancel()
        await asyncio.gather(asking, return_exceptions=True)
        assert (await amplifier.arm(CALM)).state is State.OPERATION_ENABLED
