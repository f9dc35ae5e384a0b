"""An amplifier under test: sets for it, its statuses with their times, and expectations on them."""

import asyncio
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.conformance.findings import (
    ContractViolation,
    Inconclusive,
    NotApplicable,
    expect,
)
from drivers.conformance.raw.line import RawLine
from drivers.errors import CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.guard.channel_state import Interval
from drivers.operation.plausibility import CYCLE
from drivers.protocol.messages import (
    MEASURING_ERROR,
    AmplifierState,
    Capabilities,
    Feature,
    Status,
)

LEVEL = 0.2
"""Level of driven channels unless another is given: perceptible, and far from any limit."""

LONG_WATCHDOG = 2.0  # s; does not trip during a check, on amplifiers that support it
EVENT_TIMEOUT = 5.0  # s; for changes without a request
_LEAST_POLLS = 100
_PREPARATION = 5  # exchanges whose fastest is the typical one
_BEFORE = 0.1  # s; before an event's cause, in which a delay may still count
_MANY = 20  # exchanges whose fastest shows the speed of the wire
_POLL = 0.001  # s; pause between polls for an event
_SLACK = 0.002  # s; of the amplifier's clock, and of times in milliseconds
_DRIFT = 1e-3  # of a time; of the amplifier's clock
_COARSE = 0.0025  # s; uncertainty of an event's time beyond the wire's that proves nothing

_T = TypeVar("_T")


@dataclass(frozen=True)
class Sample:
    """A status, and the interval [s] in which it was taken."""

    when: Interval
    status: Status


class Bench:
    """An open amplifier under test, and sets for it; raw, url, level: see `run_check`."""

    def __init__(
        self,
        amplifier: Amplifier,
        raw: RawLine | None = None,
        *,
        url: str = "",
        level: float = LEVEL,
    ) -> None:
        self.amplifier = amplifier
        self.url = url
        self._raw = raw
        self.can = amplifier.capabilities
        self.guard = self.guard_as(self.can)
        limits = self.guard.limits
        self.frequency = min(max(110.0, limits.frequency_min), limits.frequency_max)
        self.level = min(level, limits.level)
        self.exchange_time = 0.0  # s; the typical one of a status
        self.max_delay = 0.0  # s; of a reply, beyond the typical
        self.fed = Interval(-math.inf, math.inf)  # when the watchdog was fed last
        self.watchdog = 0.0
        self._timeouts = amplifier.statistics.timeouts
        self._since = -math.inf  # from when delays count for the event that was timed last
        # How long [s] this program did not run since a time.
        self.delayed_since: Callable[[float], float] = lambda time: 0.0

    def has(self, feature: Feature) -> bool:
        """Whether the amplifier has a feature."""
        return feature in self.can.features

    @property
    def missed_replies(self) -> int:
        """Number of replies that did not come; copies of those requests may still arrive."""
        return self.amplifier.statistics.timeouts - self._timeouts

    def require(self, feature: Feature) -> None:
        """Raise NotApplicable without a feature."""
        if not self.has(feature):
            raise NotApplicable(f"it states no {(feature.name or '').lower()}")

    @property
    def has_raw(self) -> bool:
        """Whether there is raw access to the line."""
        return self._raw is not None

    @property
    def raw(self) -> RawLine:
        """Raw access to the line; NotApplicable without."""
        if self._raw is None:
            raise NotApplicable("there is no raw access to this wire")
        return self._raw

    async def prepare(self, *, drives: bool) -> None:
        """Measure the typical exchange.

        drives: whether it must be disarmed first, as after an attempt that was cut short.
        """
        off = AmplifierState.SWITCH_ON_DISABLED
        if drives and (await self.amplifier.status()).state is not off:
            await self.rest()
        durations = []
        for _ in range(_PREPARATION):
            when = (await self.sample()).when
            durations.append(when.latest - when.earliest)
        self.exchange_time = min(durations)
        self.max_delay = 0.0

    async def fastest_exchange(self) -> float:
        """Measure the fastest of many exchanges [s], which no delay of a few makes slower."""
        durations = [self.exchange_time]
        for _ in range(_MANY):
            when = (await self.sample()).when
            durations.append(when.latest - when.earliest)
        return min(durations)

    def guard_as(self, capabilities: Capabilities) -> Guard:
        """Make a guard for an amplifier with these capabilities.

        Whether a level is one of the stroke or of the voltage makes no difference to the checks.
        """
        features = capabilities.features & ~Feature.VOLTAGE
        return Guard(GuardLimits(0.0, 1e6, 1.0), replace(capabilities, features=features))

    def tones(
        self,
        *fractions: float,
        token: int | None = None,
        ramp: float = 0.0,
        valid_for: float = 0.0,
        guard: Guard | None = None,
        first: int = 0,
        frequency: float | None = None,
        phase: float = 0.0,
        keep_phase: bool = False,
        onset: int = 0,
        ending: int = 0,
        skip_ending: bool = False,
    ) -> SafeCommandSet:
        """Make a set that drives channels from `first` on at these fractions of the test level."""
        commands = tuple(
            DriveCommand(
                first + number,
                frequency or self.frequency,
                fraction * self.level,
                phase,
                keep_phase=keep_phase,
                onset=onset,
                ending=ending,
                skip_ending=skip_ending,
            )
            for number, fraction in enumerate(fractions)
        )
        return (guard or self.guard).check(
            CommandSet(
                token=self.amplifier.next_token() if token is None else token,
                commands=commands,
                ramp=ramp,
                valid_for=valid_for,
            )
        )

    # What is sent

    async def timed(self, call: Awaitable[_T]) -> tuple[_T, Interval]:
        """Await an exchange; returns its result and the interval [s] in which it was executed."""
        earliest = clock.now()
        result = await call
        when = Interval(earliest, clock.now())
        if self.exchange_time:
            typical = 3 * self.exchange_time
            delay = when.latest - when.earliest - typical
            self.max_delay = max(self.max_delay, delay)
        return result, when

    async def arm(self, watchdog: float = LONG_WATCHDOG) -> Status:
        """Arm with a watchdog [s], or the nearest that is possible."""
        self.watchdog = min(max(watchdog, self.can.watchdog_min), self.can.watchdog_max)
        status, self.fed = await self.timed(self.amplifier.arm(self.watchdog))
        return status

    async def beat(self) -> Sample:
        """Feed the watchdog."""
        status, when = await self.timed(self.amplifier.heartbeat())
        self.fed = when
        return self._sample(when, status)

    async def apply(self, requested: SafeCommandSet) -> Interval:
        """Apply a set; returns when."""
        _, when = await self.timed(self.amplifier.apply(requested))
        self.fed = when
        return when

    async def play(self, *fractions: float, ramp: float = 0.0, valid_for: float = 0.0) -> Interval:
        """Apply a set of the first channels at these fractions of the test level."""
        return await self.apply(self.tones(*fractions, ramp=ramp, valid_for=valid_for))

    async def sample(self) -> Sample:
        """Read the status."""
        status, when = await self.timed(self.amplifier.status())
        return self._sample(when, status)

    def _sample(self, when: Interval, status: Status) -> Sample:
        """Make a sample of a status, which must have a level for each channel."""
        count = len(status.levels)
        expect(
            count == self.can.channels, "levels of Status", expected=self.can.channels, seen=count
        )
        return Sample(when, status)

    async def rest(self) -> None:
        """Bring it to silence, disarmed, nothing latched."""
        await self.amplifier.stop(0.0)
        await self.until(
            lambda status: not any(status.levels), what="silence after a stop", feed=False
        )
        await self.amplifier.clear()

    async def wait(self, duration: float) -> None:
        """Feed the watchdog for a time [s]."""
        end = clock.now() + duration
        while clock.now() < end:
            await self.beat()
            await asyncio.sleep(min(0.05, max(0.0, end - clock.now())))

    def has_passed(self, duration: float) -> bool:
        """Whether so much time [s] has passed since the watchdog was fed."""
        return clock.now() - self.fed.latest > duration

    async def pause_until(self, time: float) -> None:
        """Send nothing until a time [s]."""
        await asyncio.sleep(max(0.0, time - clock.now()))

    # What is expected

    async def levels(self) -> tuple[float, ...]:
        """Read the levels back."""
        return (await self.sample()).status.levels

    async def expect_levels(self, *fractions: float, why: str) -> None:
        """Require the first channels at these fractions of the test level, all others silent."""
        levels = await self.levels()
        expected = [fraction * self.level for fraction in fractions]
        expected += [0.0] * (len(levels) - len(fractions))
        is_met = all(abs(a - b) <= self.tolerance for a, b in zip(levels, expected, strict=True))
        expect(is_met, f"levels ({why})", expected=_rounded(expected), seen=_rounded(levels))

    @property
    def ramp(self) -> float:
        """A ramp [s] that is long against an exchange, if the amplifier plays such."""
        return min(max(0.3, 40 * self.exchange_time), self.can.ramp_max)

    @property
    def tolerance(self) -> float:
        """Of a level: two steps, or the error of an amplifier that measures its levels."""
        return max(MEASURING_ERROR, 2 * self.can.level_step)

    async def until(self, reached: Callable[[Status], bool], *, what: str, feed: bool) -> Status:
        """Poll until a status is reached; feed: whether polling feeds the watchdog.

        Time in which this program did not run does not count: at least so many polls are made.
        """
        read = self.amplifier.heartbeat if feed else self.amplifier.status
        end = clock.now() + EVENT_TIMEOUT
        polls = 0
        while clock.now() < end or polls < _LEAST_POLLS:
            status = await read()
            if reached(status):
                return status
            polls += 1
            await asyncio.sleep(0.005)
        raise ContractViolation(
            what,
            expected=f"within {EVENT_TIMEOUT:g} s",
            seen=f"{status.state.name}, levels {_rounded(status.levels)}",
        )

    async def time_of(
        self,
        reached: Callable[[Status], bool],
        *,
        since: Interval,
        due: float,
        what: str,
        margin: float = 0.04,
        feed: bool = False,
    ) -> Interval:
        """Poll around a due time [s] after `since`; returns when a status was first reached.

        The result is relative to since. Raises ContractViolation if it is not reached by `margin`
        [s] after the due time, and what the amplifier may have been delayed.
        """
        before, self._since = since.latest, since.earliest - _BEFORE
        await self.pause_until(since.earliest + due - min(margin / 2, due / 4))
        while True:
            sample = await (self.beat() if feed else self.sample())
            if reached(sample.status):
                return Interval(before - since.latest, sample.when.latest - since.earliest)
            before = sample.when.earliest
            latest = due + margin + 4 * self.exchange_time
            if before - since.latest > latest + self.delayed_since(since.earliest - _BEFORE):
                raise ContractViolation(
                    what,
                    expected=f"{due * 1e3:.0f} ms after its request",
                    seen=f"not after {(before - since.latest) * 1e3:.0f} ms: "
                    f"{sample.status.state.name}, levels {_rounded(sample.status.levels)}",
                    is_certain=True,
                )
            await asyncio.sleep(_POLL)

    def expect_time(
        self, what: str, seen: Interval, *, low: float, high: float, coarse: float = _COARSE
    ) -> None:
        """Require that an event came between two times [s]; Inconclusive if that is not certain.

        coarse [s]: uncertainty, beyond the wire's, that proves nothing.
        """
        bounds = f"{low * 1e3:.0f} to {high * 1e3:.0f} ms"
        found = f"{max(seen.earliest, 0.0) * 1e3:.1f} to {seen.latest * 1e3:.1f} ms"
        delayed = self.delayed_since(self._since)
        early, late = low * (1 - _DRIFT) - _SLACK, high * (1 + _DRIFT) + _SLACK
        if seen.latest < early or seen.earliest > late:
            raise ContractViolation(
                what,
                expected=bounds,
                seen=found,
                is_certain=seen.latest < early - delayed or seen.earliest > late + delayed,
            )
        uncertain = max(coarse, 2 * self.exchange_time)
        if seen.earliest < early - uncertain or seen.latest > late + uncertain:
            raise Inconclusive(f"{what} must be {bounds}, and was within {found}")

    def expect_state(
        self, status: Status, state: AmplifierState, *, after: str, is_certain: bool = False
    ) -> None:
        """Require a state; is_certain: whether no delay can lead to another."""
        expect(
            status.state is state,
            f"state after {after}",
            expected=state.name,
            seen=status.state.name,
            is_certain=is_certain,
        )

    async def refused(self, call: Awaitable[object], *, what: str, is_certain: bool = True) -> None:
        """Require a refusal; is_certain: whether no delay can make a reply right."""
        try:
            await call
        except CommandRefused:
            return
        raise ContractViolation(what, expected="refused", seen="a reply", is_certain=is_certain)

    def expect_not_fed(self, sample: Sample, *, by: str) -> None:
        """Require that the watchdog runs down since it was fed last."""
        elapsed = sample.when.earliest - self.fed.latest
        highest = self.watchdog - elapsed * (1 - _DRIFT) + _SLACK
        expect(
            sample.status.watchdog_left <= highest,
            f"watchdog_left after {by}",
            expected=f"at most {highest * 1e3:.0f} ms",
            seen=f"{sample.status.watchdog_left * 1e3:.0f} ms",
            is_certain=not self.missed_replies
            and sample.status.watchdog_left > highest + self.delayed_since(self.fed.earliest),
        )

    def expect_fed(self, sample: Sample, *, by: str) -> None:
        """Require the time that is left of the watchdog, fed by the last request that does."""
        elapsed = sample.when.latest - self.fed.earliest
        lowest = self.watchdog - elapsed * (1 + _DRIFT) - _SLACK
        expect(
            sample.status.watchdog_left >= lowest,
            f"watchdog_left after {by}",
            expected=f"at least {lowest * 1e3:.0f} ms",
            seen=f"{sample.status.watchdog_left * 1e3:.0f} ms",
        )
        self.expect_not_fed(sample, by=by)

    def wider(self, **changes: object) -> Guard:
        """Make a guard for an amplifier that could do more than this one."""
        values: dict[str, Any] = {"channel_limits": (), **changes}
        return self.guard_as(replace(self.can, **values))


def _rounded(levels: object) -> tuple[float, ...]:
    return tuple(round(level, 4) for level in levels)  # type: ignore[attr-defined]


__all__ = ["CYCLE", "Bench", "Sample", "expect"]
