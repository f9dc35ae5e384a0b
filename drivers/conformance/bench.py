"""An amplifier under test: sets for it, and expectations on its status."""

import asyncio
from collections.abc import Awaitable, Callable

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import AmplifierState, Capabilities, Status

LEVEL = 0.2
"""Level of driven channels: perceptible, and far from any limit."""

LONG_WATCHDOG = 2.0  # s; does not trip during a check, on amplifiers that support it
EVENT_TIMEOUT = 5.0  # s; for changes without a request
_LEAST_POLLS = 100
LEVEL_TOLERANCE = 0.002  # of full stroke; for amplifiers that measure their levels


class ContractViolation(Exception):
    """The amplifier does not behave as the contract says."""


class Bench:
    """An open amplifier under test, and sets for it."""

    def __init__(self, amplifier: Amplifier) -> None:
        self.amplifier = amplifier
        self.can = amplifier.capabilities
        self.frequency = min(max(110.0, self.can.frequency_min), self.can.frequency_max)
        self.level = min(LEVEL, self.can.level_max)
        self.guard = self.guard_as(self.can)

    def guard_as(self, capabilities: Capabilities) -> Guard:
        """Make a guard for an amplifier with these capabilities."""
        return Guard(GuardLimits(0.0, 1e6, 1.0), capabilities)

    def tones(
        self,
        *fractions: float,
        token: int | None = None,
        ramp: float = 0.0,
        valid_for: float = 0.0,
        guard: Guard | None = None,
        first: int = 0,
    ) -> SafeCommandSet:
        """Make a set that drives channels from `first` on at these fractions of the test level."""
        commands = tuple(
            DriveCommand(first + number, self.frequency, fraction * self.level)
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

    async def arm(self) -> Status:
        """Arm with a long watchdog."""
        return await self.amplifier.arm(min(LONG_WATCHDOG, self.can.watchdog_max))

    async def levels(self) -> tuple[float, ...]:
        """Read the levels back."""
        return (await self.amplifier.status()).levels

    async def expect_levels(self, *fractions: float, why: str) -> None:
        """Require the first channels at these fractions of the test level, all others silent."""
        levels = await self.levels()
        expected = [fraction * self.level for fraction in fractions]
        expected += [0.0] * (len(levels) - len(fractions))
        is_met = all(abs(a - b) <= LEVEL_TOLERANCE for a, b in zip(levels, expected, strict=True))
        expect(is_met, f"{why}: levels must be {tuple(expected)}, got {levels}")

    async def wait(self, duration: float) -> None:
        """Feed the watchdog for a time [s]."""
        end = clock.now() + duration
        while clock.now() < end:
            await self.amplifier.heartbeat()
            await asyncio.sleep(0.05)

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
            f"{what} must happen within {EVENT_TIMEOUT:g} s, got {status.state.name}, levels "
            f"{status.levels}"
        )

    def expect_state(self, status: Status, state: AmplifierState, *, after: str) -> None:
        """Require a state."""
        expect(
            status.state is state,
            f"state after {after} must be {state.name}, got {status.state.name}",
        )

    async def refused(self, call: Awaitable[object], *, what: str) -> None:
        """Require a refusal."""
        try:
            await call
        except CommandRefused:
            return
        raise ContractViolation(f"{what} must be refused, got a reply")

    async def rest(self) -> None:
        """Bring it to silence, disarmed, nothing latched."""
        await self.amplifier.stop(0.0)
        await self.until(
            lambda status: not any(status.levels), what="silence after a stop", feed=False
        )
        await self.amplifier.clear()


def expect(condition: bool, problem: str) -> None:
    """Raise ContractViolation with the problem unless the condition holds."""
    if not condition:
        raise ContractViolation(problem)
