"""Sets are held back until the amplifier has room for another voice, by the simulated amplifier."""

import asyncio
import contextlib
import random

import pytest

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import DriverError, Preempted
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import Achieved, AmplifierState, Apply, Nak, NakCode, Ping, Reply
from long_form import shortly
from lossy_backend import DELAY, Fate, LossyBackend
from sim.amplifier.amplifier import SimulatedAmplifier
from virtual_loop import in_virtual_time

RAMP, LAG = 0.2, 0.002  # s


class Bench:
    """An armed amplifier over a backend that remembers refusals for a voice too many."""

    def __init__(self, voices: int = 2) -> None:
        self.refused = 0
        simulated = SimulatedAmplifier("main", channels=3, voices=voices)
        handle = simulated.handle

        def remember(request: object, now: float) -> Reply:
            reply = handle(request, now)  # type: ignore[arg-type]
            self.refused += isinstance(reply, Nak) and reply.code is NakCode.FADING
            return reply

        simulated.handle = remember  # type: ignore[method-assign]
        self.backend = LossyBackend(simulated)
        self.amplifier = Amplifier(self.backend)

    async def start(self, watchdog: float = 2.0) -> None:
        await self.amplifier.open()
        self.guard = Guard(GuardLimits(40.0, 500.0, 1.0), self.amplifier.capabilities)
        await self.amplifier.arm(watchdog)

    def tone(self, frequency: float, *, level: float = 0.3, ramp: float = RAMP) -> SafeCommandSet:
        """A set that drives channel 0."""
        commands = (DriveCommand(0, frequency, level, skip_ending=True),)
        token = self.amplifier.next_token()
        return self.guard.check(CommandSet(token, commands, ramp=ramp, valid_for=0.0))

    async def fade(self) -> float:
        """Let channel 0 fade between two sets; returns when the reply to the second came [s]."""
        await self.amplifier.apply(self.tone(110.0, ramp=0.0))
        await self.amplifier.apply(self.tone(150.0))
        return clock.now()


@in_virtual_time
async def test_third_set_is_sent_when_the_older_voice_must_have_ended() -> None:
    """A ramp after the reply to the set before, and the lag of 2 ms."""
    bench = Bench()
    await bench.start()
    replied_at = await bench.fade()
    achieved = await bench.amplifier.apply(third := bench.tone(190.0))
    assert isinstance(achieved, Achieved)
    assert achieved.token == third.token
    assert clock.now() - DELAY - replied_at == pytest.approx(RAMP + LAG)
    assert bench.refused == 0


@in_virtual_time
async def test_amplifier_of_five_voices_takes_five_at_once() -> None:
    """The sixth waits for the first of the four that fade."""
    bench = Bench(voices=5)
    await bench.start()
    replied_at = await bench.fade()
    for frequency in (170.0, 190.0, 210.0):
        await bench.amplifier.apply(bench.tone(frequency))
    assert clock.now() - replied_at == pytest.approx(3 * DELAY)
    await bench.amplifier.apply(bench.tone(230.0))
    assert clock.now() - DELAY - replied_at == pytest.approx(RAMP + LAG)
    assert bench.refused == 0


@in_virtual_time
async def test_amplifier_of_many_voices_is_sent_sixteen_at_once() -> None:
    """The seventeenth waits, so that the guard follows no more."""
    bench = Bench(voices=255)
    await bench.start()
    replied_at = await bench.fade()
    for number in range(14):
        await bench.amplifier.apply(bench.tone(170.0 + number))
    assert clock.now() - replied_at == pytest.approx(14 * DELAY)
    await bench.amplifier.apply(bench.tone(230.0))
    assert clock.now() - DELAY - replied_at == pytest.approx(RAMP + LAG)


@in_virtual_time
async def test_newer_set_takes_the_place_of_the_one_that_waits() -> None:
    """The older one is never sent."""
    bench = Bench()
    await bench.start()
    await bench.fade()
    older, newer = bench.tone(190.0), bench.tone(230.0)
    waiting = asyncio.create_task(bench.amplifier.apply(older))
    await asyncio.sleep(0.05)
    await bench.amplifier.apply(newer)
    with pytest.raises(Preempted):
        await waiting
    sent = [one.command_set.token for one in bench.backend.sent if isinstance(one, Apply)]
    assert older.token not in sent
    assert sent[-1] == newer.token


@pytest.mark.parametrize("how", ["silent set", "stop", "disarm", "stop_on_bus", "abort_unsent"])
@in_virtual_time
async def test_what_silences_does_not_wait_and_ends_the_wait(how: str) -> None:
    """Within one exchange."""
    bench = Bench()
    await bench.start()
    await bench.fade()
    waiting = asyncio.create_task(bench.amplifier.apply(bench.tone(190.0)))
    await asyncio.sleep(0.01)
    begin = clock.now()
    if how == "silent set":
        await bench.amplifier.apply(bench.tone(190.0, level=0.0))
    elif how == "abort_unsent":
        bench.amplifier.abort_unsent()
    else:
        await getattr(bench.amplifier, how)()
    assert clock.now() - begin <= DELAY + 1e-9
    with pytest.raises(Preempted):
        await waiting


@in_virtual_time
async def test_set_that_waits_feeds_the_watchdog() -> None:
    """Of 100 ms, along a ramp of a second."""
    bench = Bench()
    await bench.start(0.1)
    await bench.amplifier.apply(bench.tone(110.0, ramp=0.0))
    await bench.amplifier.apply(bench.tone(150.0, ramp=1.0))
    await bench.amplifier.apply(bench.tone(190.0))
    assert bench.backend.amplifier.state is AmplifierState.OPERATION_ENABLED
    assert sum(isinstance(one, Ping) for one in bench.backend.sent) >= 40


@in_virtual_time
async def test_sets_that_need_no_room_are_sent_at_once() -> None:
    """Without a ramp, on another channel, and the same again."""
    bench = Bench()
    await bench.start()
    await bench.fade()
    begin = clock.now()
    other = CommandSet(bench.amplifier.next_token(), (DriveCommand(1, 90.0, 0.3),), RAMP, 0.0)
    await bench.amplifier.apply(safe := bench.guard.check(other))
    await bench.amplifier.apply(safe)
    await bench.amplifier.apply(bench.tone(190.0, ramp=0.0))
    assert clock.now() - begin == pytest.approx(3 * DELAY)


@in_virtual_time
async def test_unconfirmed_set_is_assumed_to_fade_as_late_as_it_can() -> None:
    """All its replies are lost: it may have played up to 30 ms after the last attempt."""
    bench = Bench()
    await bench.start()
    await bench.amplifier.apply(bench.tone(110.0, ramp=0.0))
    bench.backend.fate = lambda request: (
        Fate.REPLY_LOST if isinstance(request, Apply) else Fate.DELIVERED
    )
    with pytest.raises(DriverError):
        await bench.amplifier.apply(bench.tone(150.0))
    bench.backend.fate = lambda request: Fate.DELIVERED
    room = bench.tone(190.0)
    assert room.record.room_from(room) == pytest.approx(clock.now() + 0.03 + RAMP + LAG, abs=0.04)
    await bench.amplifier.status()  # restores the link
    await bench.amplifier.apply(room)
    assert bench.refused == 0


@pytest.mark.parametrize("seed", shortly(range(60), range(12)))
@in_virtual_time
async def test_host_never_sends_a_voice_too_many(seed: int) -> None:
    """Random sets, envelopes, pauses and lost frames; two voices and more."""
    rng = random.Random(seed)
    bench = Bench(voices=2 + seed % 3)
    await bench.start()
    for slot in (1, 2):
        knots = tuple(Knot(0.2, 0.0) for _ in range(rng.randint(1, 4)))
        await bench.amplifier.load_envelope(bench.guard.check_envelope(Envelope(slot, 0.01, knots)))
    bench.backend.fate = lambda request: rng.choices(
        [Fate.DELIVERED, Fate.REQUEST_LOST, Fate.REPLY_LOST], [8, 1, 1]
    )[0]
    for _ in range(60):
        commands = tuple(
            DriveCommand(
                channel,
                rng.choice([110.0, 150.0]),
                rng.choice([0.0, 0.1, 0.3]),
                keep_phase=rng.random() < 0.4,
                onset=rng.choice([0, 0, 1]),
                ending=rng.choice([0, 0, 2]),
                skip_ending=rng.random() < 0.5,
            )
            for channel in rng.sample(range(3), rng.randint(0, 3))
        )
        wanted = CommandSet(
            bench.amplifier.next_token(),
            commands,
            ramp=rng.choice([0.0, 0.005, 0.04, 0.2]),
            valid_for=rng.choice([0.0, 0.0, 0.02]),
        )
        with contextlib.suppress(TimeoutError, DriverError):
            safe = bench.guard.check(wanted)
            if rng.random() < 0.3:
                await bench.amplifier.stage(safe)
                await bench.amplifier.commit(safe.token)
            elif rng.random() < 0.1:
                await bench.amplifier.stage(safe)
            else:
                await asyncio.wait_for(bench.amplifier.apply(safe), rng.choice([0.001, 2.0]))
        await asyncio.sleep(rng.choice([0.0, 0.003, 0.02, 0.1]))
        if rng.random() < 0.3 or bench.amplifier.is_degraded:
            with contextlib.suppress(DriverError):
                await bench.amplifier.status()
        assert bench.refused == 0
