"""The guard drives a simulated amplifier: no limit is ever exceeded there."""

import asyncio
import contextlib
import math
from collections import deque
from dataclasses import dataclass, field, replace

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import DriverError
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import Apply, Commit, Nak, NakCode, Reply, Request
from lossy_backend import Fate, LossyBackend
from sim.amplifier.amplifier import SimulatedAmplifier
from sim.waveform import level_of
from virtual_loop import run_virtual

STEP = 0.001  # s; between measurements
FINE = 1e-6
# A ramp is a raised cosine, at its middle that much steeper than on the whole.
STEEPEST = math.pi / 2


@dataclass
class Meter:
    """Measures an amplifier; `violations` are exceeded limits."""

    amplifier: SimulatedAmplifier
    limits: GuardLimits
    violations: list[str] = field(default_factory=list)
    _before: tuple[float, ...] = ()
    _on_since: float | None = None
    _on: deque[tuple[float, float]] = field(default_factory=deque)
    _sets: deque[float] = field(default_factory=deque)
    _last: float = 0.0

    async def run(self) -> None:
        """Measure until cancelled."""
        while True:
            self.measure(clock.now())
            await asyncio.sleep(STEP)

    def measure(self, now: float) -> None:
        """Compare one moment with the limits."""
        self.amplifier.tick(now)
        # Not as the status reports them, which ends at full stroke.
        levels = tuple(level_of(output, now) for output in self.amplifier.outputs)
        limits = self.limits
        for channel, level in enumerate(levels):
            if level > limits.level + FINE:
                self.violations.append(f"{now:.3f}: level {level}")
            rise = level - self._before[channel] if self._before else level
            if rise > limits.slew * STEEPEST * (now - self._last) + FINE:
                self.violations.append(f"{now:.4f}: channel {channel} rose by {rise}")
        if sum(level**2 for level in levels) > limits.power + FINE:
            self.violations.append(f"{now:.3f}: power of {levels}")
        self._measure_times(now, is_on=any(levels))
        self._before, self._last = levels, now

    def _measure_times(self, now: float, *, is_on: bool) -> None:
        if is_on and self._on_since is None:
            self._on_since = now
        elif not is_on and self._on_since is not None:
            self._on.append((self._on_since, now - STEP))
            self._on_since = None
        spans = [*self._on, *([(self._on_since, now)] if self._on_since is not None else [])]
        if spans and spans[-1][1] - spans[-1][0] > self.limits.on_time + FINE:
            self.violations.append(f"{now:.3f}: on since {spans[-1][0]}")
        if self.limits.duty < 1 and is_on:
            used = sum(max(0.0, end - max(begin, now - 10.0)) for begin, end in spans)
            if used > 10.0 * self.limits.duty + FINE:
                self.violations.append(f"{now:.3f}: on for {used} s of 10")

    def count(self, now: float) -> None:
        """Count a set that begins to play."""
        self._sets.append(now)
        while self._sets[0] <= now - 1.0:
            self._sets.popleft()
        if len(self._sets) > self.limits.rate:
            self.violations.append(f"{now:.3f}: {len(self._sets)} sets within a second")


class MeteredBackend(LossyBackend):
    """Counts the sets that begin to play."""

    def __init__(self, amplifier: SimulatedAmplifier, meter: Meter) -> None:
        super().__init__(amplifier)
        self._meter = meter

    def _deliver(self, request: Request, arriving: "asyncio.Future[Reply]") -> None:
        before = self.amplifier.status(clock.now()).token
        self._meter.measure(clock.now())
        super()._deliver(request, arriving)
        reply = arriving.result()
        if isinstance(reply, Nak) and reply.code is NakCode.FADING:
            self._meter.violations.append(f"{clock.now():.3f}: a voice too many")
        plays = isinstance(request, Apply | Commit) and not isinstance(reply, Nak)
        is_new = plays and self.amplifier.status(clock.now()).token != before
        if is_new and any(tone.is_lasting for tones in self.amplifier.outputs for tone in tones):
            self._meter.count(clock.now())


commands = st.builds(
    DriveCommand,
    channel=st.integers(0, 1),
    frequency=st.sampled_from([110.0, 250.0]),
    level=st.sampled_from([0.0, 0.1, 0.333333, 0.8, 1.0]),
    phase=st.sampled_from([0.0, 180.0, 77.0]),
    keep_phase=st.booleans(),
    onset=st.sampled_from([0, 0, 0, 1]),
    ending=st.sampled_from([0, 0, 0, 2]),
    skip_ending=st.booleans(),
)
sets = st.builds(
    CommandSet,
    token=st.just(0),
    commands=st.lists(
        commands, max_size=2, min_size=1, unique_by=lambda command: command.channel
    ).map(tuple),
    ramp=st.sampled_from([0.0, 0.0104, 0.05, 0.2]),
    valid_for=st.sampled_from([0.0, 0.0, 0.0003, 0.03, 0.3]),
)
envelopes = st.builds(
    Envelope,
    slot=st.sampled_from([1, 2]),
    step=st.sampled_from([0.01, 0.04]),
    knots=st.lists(
        st.builds(Knot, st.sampled_from([0.0, 0.2, 0.5]), st.sampled_from([0.0, 90.0])), max_size=3
    ).map(tuple),
)
pauses = st.tuples(st.just("pause"), st.sampled_from([0.003, 0.011, 0.045, 0.09, 0.3, 1.0]))
playing = st.tuples(st.sampled_from(["apply"] * 4 + ["hold", "play_staged", "burst"]), sets)
ending = st.tuples(
    st.sampled_from(["silence", "commit", "stop", "disarm", "rearm", "rearm"]), st.none()
)
losing = st.tuples(
    st.just("lose"),
    st.lists(st.sampled_from([Fate.REQUEST_LOST, Fate.REPLY_LOST]), min_size=1, max_size=4),
)
loading = st.tuples(st.just("load"), envelopes)
actions = st.one_of(playing, pauses, playing, pauses, playing, pauses, ending, losing, loading)
LIMITS = [
    GuardLimits(40.0, 500.0, 1.0, slew=10.0),
    GuardLimits(40.0, 500.0, 0.8, power=0.9),
    GuardLimits(40.0, 500.0, 1.0, on_time=0.9),
    GuardLimits(40.0, 500.0, 1.0, duty=0.08),
    GuardLimits(40.0, 500.0, 1.0, rate=5.0),
    GuardLimits(40.0, 500.0, 1.0, slew=20.0, power=1.0, on_time=1.5, duty=0.1, rate=10.0),
]


class Driver:
    """Carries out actions on an amplifier."""

    def __init__(self, limits: GuardLimits, voices: int) -> None:
        simulated = SimulatedAmplifier("main", channels=2, voices=voices)
        self.meter = Meter(simulated, limits)
        self.backend = MeteredBackend(simulated, self.meter)
        self.amplifier = Amplifier(self.backend)
        self.limits = limits
        self.held: SafeCommandSet | None = None
        self.staged = 0

    async def run(self, script: list[tuple[str, object]]) -> list[str]:
        """Carry out a script; returns the exceeded limits."""
        await self.amplifier.open()
        self.guard = Guard(self.limits, self.amplifier.capabilities)
        await self.amplifier.arm(2.0)
        for slot in (1, 2):
            await self._load(Envelope(slot, 0.02, (Knot(0.1, 0.0), Knot(0.2, 0.0))))
        measuring = asyncio.create_task(self.meter.run())
        for name, argument in script:
            await self._beat()
            held, self.held = self.held, None
            with contextlib.suppress(DriverError):
                await getattr(self, f"_{name}")(argument)
            if held is not None:
                with contextlib.suppress(DriverError):
                    await self.amplifier.apply(held)
            if self.amplifier.is_lost:
                await self.amplifier.close()
                self.backend.fate = lambda request: Fate.DELIVERED
                await self.amplifier.open()
                await self._rearm()
        await asyncio.sleep(0.5)
        measuring.cancel()
        return self.meter.violations

    def _checked(self, wanted: CommandSet) -> SafeCommandSet:
        return self.guard.check(replace(wanted, token=self.amplifier.next_token()))

    async def _apply(self, wanted: CommandSet) -> None:
        await self.amplifier.apply(self._checked(wanted))

    async def _burst(self, wanted: CommandSet) -> None:
        for _ in range(6):
            await self._apply(wanted)

    async def _hold(self, wanted: CommandSet) -> None:
        self.held = self._checked(wanted)

    async def _play_staged(self, wanted: CommandSet) -> None:
        safe = self._checked(wanted)
        self.staged = safe.token
        await self.amplifier.stage(safe)
        await self.amplifier.commit(safe.token)

    async def _commit(self, _: None) -> None:
        await self.amplifier.commit(self.staged or 1)

    async def _load(self, envelope: Envelope) -> None:
        await self.amplifier.load_envelope(self.guard.check_envelope(envelope))

    async def _silence(self, _: None) -> None:
        token = self.amplifier.next_token()
        await self.amplifier.apply(self.guard.silence(token, [0, 1], ramp=0.02))

    async def _stop(self, _: None) -> None:
        await self.amplifier.stop()

    async def _disarm(self, _: None) -> None:
        await self.amplifier.disarm()

    async def _rearm(self, _: None = None) -> None:
        await self.amplifier.stop()
        await asyncio.sleep(0.02)
        await self.amplifier.clear()
        await self.amplifier.arm(2.0)

    async def _beat(self, _: None = None) -> None:
        with contextlib.suppress(DriverError):
            await self.amplifier.heartbeat()

    async def _pause(self, duration: float) -> None:
        await asyncio.sleep(duration)

    async def _lose(self, fates: list[Fate]) -> None:
        remaining = iter(fates)
        self.backend.fate = lambda request: next(remaining, Fate.DELIVERED)


@pytest.mark.parametrize("limits", LIMITS, ids=["slew", "power", "on", "duty", "rate", "all"])
@given(voices=st.sampled_from([2, 3, 8]), script=st.lists(actions, min_size=12, max_size=40))
@settings(
    max_examples=10,
    deadline=None,
    phases=[Phase.explicit, Phase.reuse, Phase.generate],  # shrinking takes minutes
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
def test_no_limit_is_exceeded_on_the_amplifier(
    limits: GuardLimits, voices: int, script: list[tuple[str, object]]
) -> None:
    """Random sets, envelopes, pauses, losses, stops and re-arms; two voices a channel, and more."""
    assert run_virtual(Driver(limits, voices).run(script)) == []
