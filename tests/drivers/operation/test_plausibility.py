"""What contradicts a request: amplifiers with one lie each, and honest ones at any rate of sets."""

import asyncio
import contextlib
import random
from dataclasses import replace

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandRefused
from drivers.guard import Guard, GuardLimits
from drivers.operation.plausibility import PlausibilityCheck
from drivers.protocol.messages import AmplifierState, Fault, Reply, Request
from lies import Lie, achieved, status
from lossy_backend import LossyBackend
from sim.amplifier.amplifier import SimulatedAmplifier
from virtual_loop import in_virtual_time

WATCHDOG = 0.25
BEAT = 0.05  # s


class LyingBackend(LossyBackend):
    """Alters every reply."""

    def __init__(self, lie: Lie) -> None:
        super().__init__(SimulatedAmplifier("main", channels=3))
        self.lie: Lie = lambda reply: reply
        self.told = lie

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        return self.lie(await super().exchange(request, timeout=timeout))


class Bench:
    """A guard, an amplifier and its check, with commands as the control loop gives them."""

    def __init__(self, lie: Lie = lambda reply: reply) -> None:
        self.backend = LyingBackend(lie)
        self.amplifier = Amplifier(self.backend)

    async def start(self) -> None:
        """Open and arm, without lies."""
        await self.amplifier.open()
        self.guard = Guard(GuardLimits(40.0, 500.0, 1.0), self.amplifier.capabilities)
        self.check = PlausibilityCheck(self.amplifier.capabilities)
        begin = clock.now()
        await self.amplifier.arm(WATCHDOG)
        self.check.expect_armed(WATCHDOG, sent_at=begin, now=clock.now())
        self.backend.lie = self.backend.told

    async def play(self, *commands: DriveCommand, ramp: float = 0.02, valid_for: float = 0) -> None:
        """Play a set, and check its reply."""
        token = self.amplifier.next_token()
        safe = self.guard.check(CommandSet(token, commands, ramp=ramp, valid_for=valid_for))
        begin = clock.now()
        self.check.forget(safe)
        reply = await self.amplifier.apply(safe)
        self.check.expect(safe, sent_at=begin, now=clock.now())
        self.check.check_achieved(safe, reply)

    async def play_unconfirmed(self, *commands: DriveCommand, ramp: float = 0.0) -> None:
        """Play a set whose reply is lost."""
        token = self.amplifier.next_token()
        safe = self.guard.check(CommandSet(token, commands, ramp=ramp, valid_for=0.0))
        self.check.forget(safe)
        await self.amplifier.apply(safe)

    async def read(self, *, feeds: bool = True) -> None:
        """Read the status, by a heartbeat or without one, and check it."""
        begin = clock.now()
        reply = await (self.amplifier.heartbeat() if feeds else self.amplifier.status())
        self.check.check_status(reply, sent_at=begin, now=clock.now(), feeds=feeds)

    async def read_running(self) -> None:
        """Read the status before a heartbeat, and check that the watchdog runs down."""
        begin, fed = clock.now(), self.amplifier.last_fed_at
        assert fed is not None
        self.check.check_running(await self.amplifier.status(), sent_at=begin, last_fed_at=fed)


STRONG, OTHER = DriveCommand(0, 110.0, 0.5), DriveCommand(1, 110.0, 0.3, 45.0)
WEAK = DriveCommand(2, 110.0, 0.002)


def dead(levels: tuple[float, ...]) -> tuple[float, ...]:
    """Silence channel 2."""
    return (*levels[:2], 0.0)


def swapped(levels: tuple[float, ...]) -> tuple[float, ...]:
    """Exchange channels 0 and 1."""
    return (levels[1], levels[0], *levels[2:])


LIES = {
    "high voltage is off": (status(high_voltage=False), "high voltage"),
    "token is one behind": (status(token=lambda token: token - 1 or 65535), "playing set"),
    "watchdog does not run": (status(watchdog_left=WATCHDOG), "watchdog left"),
    "watchdog stands at another time": (status(watchdog_left=0.1), "watchdog left"),
    "watchdog stands a little below full": (status(watchdog_left=0.2), "watchdog left"),
    "levels are swapped": (status(levels=swapped), "level of channel [01]"),
    "levels are all zero": (status(levels=(0.0,) * 3), "level of channel [01]"),
    "a weak channel is dead": (status(levels=dead), "level of channel 2"),
    "frequency is 5 Hz high": (
        achieved(frequency=lambda value: value + 5.0),
        "frequency achieved on channel 0",
    ),
    "frequency is two steps high": (
        achieved(frequency=lambda value: value + 0.1),
        "frequency achieved on channel 0",
    ),
    "phase is negated": (
        achieved(phase=lambda value: value + 180.0),
        "phase achieved on channel 0",
    ),
    "level is halved": (achieved(level=lambda value: value / 2), "level achieved on channel 0"),
    "another channel plays": (
        achieved(channel=lambda value: 2 - value),
        "level achieved on channel 0",
    ),
}


@pytest.mark.parametrize("name", LIES)
@pytest.mark.parametrize("is_touched", [False, True])
@in_virtual_time
async def test_second_contradiction_is_a_fault(name: str, is_touched: bool) -> None:
    """Within a second: at rest, and while the set changes more often than it is read."""
    lie, reason = LIES[name]
    bench = Bench(lie)

    async def drive() -> None:
        for step in range(20):
            if is_touched or step == 0:
                for frequency in (110.0, 111.0, 112.0):
                    tones = (replace(one, frequency=frequency) for one in (STRONG, OTHER, WEAK))
                    await bench.play(*tones)
                    await asyncio.sleep(0.012)
            await bench.read()
            await asyncio.sleep(BEAT)
            await bench.read_running()

    await bench.start()
    with pytest.raises(CommandRefused, match=f"contradicts.*{reason}"):
        await drive()


@pytest.mark.parametrize("level", [0.0001, 0.005])
@in_virtual_time
async def test_dead_channel_is_a_fault_at_the_weakest_level(level: float) -> None:
    """One step of the wire, and half of what may be a measuring error at a strong level."""
    bench = Bench(status(levels=dead))
    await bench.start()
    await bench.play(STRONG, replace(WEAK, level=level))
    await asyncio.sleep(0.1)
    await bench.read()
    with pytest.raises(CommandRefused, match="level of channel 2"):
        await bench.read()


@in_virtual_time
async def test_heartbeat_that_did_not_feed_is_no_contradiction() -> None:
    """Two in a row, as when the frame that feeds it on CAN is lost: the watchdog runs on."""
    bench = Bench()
    await bench.start()
    for _ in range(2):
        await asyncio.sleep(BEAT)
        begin = clock.now()
        reply = await bench.amplifier.status()
        bench.check.check_status(reply, sent_at=begin, now=clock.now(), feeds=True)
        assert bench.check._contradictions == 0


@in_virtual_time
async def test_amplifier_that_is_not_enabled_is_a_fault_at_once() -> None:
    """With its state and fault."""
    bench = Bench(status(state=AmplifierState.FAULT, fault=Fault.ARC))
    await bench.start()
    await bench.play(STRONG)
    with pytest.raises(CommandRefused, match=r"OPERATION_ENABLED, got FAULT with fault ARC"):
        await bench.read()


@in_virtual_time
async def test_one_contradiction_is_no_fault() -> None:
    """The next status agrees again."""
    bench = Bench()
    await bench.start()
    await bench.play(STRONG)
    await asyncio.sleep(0.1)
    for _ in range(3):
        bench.backend.lie = status(high_voltage=False)
        await bench.read()
        bench.backend.lie = bench.backend.told
        await bench.read()


@in_virtual_time
async def test_unconfirmed_set_is_not_compared() -> None:
    """It may play or not; what is confirmed next is compared once it has settled."""
    bench = Bench()
    await bench.start()
    await bench.play(STRONG)
    await bench.play_unconfirmed(replace(OTHER, level=0.9))
    for _ in range(3):
        await bench.read()
    await bench.play(WEAK, ramp=0.2)
    for _ in range(6):
        await bench.read()
        await asyncio.sleep(BEAT)
    bench.backend.lie = status(levels=(0.0,) * 3)
    await bench.read()
    with pytest.raises(CommandRefused, match="channel 2"):
        await bench.read()


@given(seed=st.integers(0, 2**32))
@example(66104270)  # an ending after an envelope to silence, over a tone that fades
@settings(max_examples=25, deadline=None)
@in_virtual_time
async def test_honest_amplifier_is_never_contradicted(seed: int) -> None:
    """Random tones, ramps, envelopes, lost replies and pauses."""
    rng = random.Random(seed)
    bench = Bench()
    await bench.start()
    for slot in (1, 2):
        knots = tuple(Knot(rng.choice([0.1, 0.4]), rng.choice([0.0, 90.0])) for _ in range(3))
        await bench.amplifier.load_envelope(bench.guard.check_envelope(Envelope(slot, 0.01, knots)))
    bench.backend.lie = lambda reply: reply
    for _ in range(40):
        tones = [
            DriveCommand(
                channel,
                rng.choice([110.0, 110.0, 250.0]),
                rng.choice([0.0, 0.002, 0.4]),
                rng.choice([0.0, 120.0]),
                keep_phase=rng.random() < 0.5,
                onset=rng.choice([0, 0, 1]),
                ending=rng.choice([0, 0, 2]),
                skip_ending=rng.random() < 0.5,
            )
            for channel in range(3)
        ]
        ramp, valid_for = rng.choice([0.0, 0.02, 0.2]), rng.choice([0.0, 0.0, 0.03])
        with contextlib.suppress(CommandRefused):  # by the guard, for an onset over a loud tone
            if rng.random() < 0.15:
                await bench.play_unconfirmed(*tones, ramp=ramp)
            else:
                await bench.play(*tones, ramp=ramp, valid_for=valid_for)
        for _ in range(2):
            await asyncio.sleep(rng.choice([0.0, 0.005, 0.02, 0.06]))
            await bench.read_running()
            # The next pauses are not longer than half the watchdog time.
            overdue = clock.now() - (bench.amplifier.last_fed_at or 0.0) > WATCHDOG / 2
            await bench.read(feeds=overdue or rng.random() < 0.7)
            assert bench.check._contradictions == bench.check._stalled_watchdog_count == 0
