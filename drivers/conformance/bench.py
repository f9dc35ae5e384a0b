"""An amplifier under test, what it is asked to play, and what must be the case then."""

import asyncio
from collections.abc import Awaitable, Callable

from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import Guard, GuardLimits, SafeCommandSet
from drivers.protocol.messages import Capabilities, Status

LEVEL = 0.2
"""At which channels vibrate: felt by a finger, and far from any limit."""

CALM = 2.0  # s; a watchdog that does not trip while a check goes on, where there is one so long
PATIENCE = 5.0  # s; for what comes by itself
LEVEL_ERROR = 0.002  # of full stroke; of an amplifier that measures


class ContractBroken(Exception):
    """The amplifier does something else than the contract says."""


class Bench:
    """An open amplifier under test, and sets for it."""

    def __init__(self, amplifier: Amplifier) -> None:
        self.amplifier = amplifier
        self.can = amplifier.capabilities
        self.frequency = min(max(110.0, self.can.frequency_min), self.can.frequency_max)
        self.level = min(LEVEL, self.can.level_max)
        self.guard = self.guard_as(self.can)

    def guard_as(self, capabilities: Capabilities) -> Guard:
        """A guard for an amplifier that can do this."""
        return Guard(GuardLimits(0.0, 1e6, 1.0), capabilities)

    def tones(
        self,
        *shares: float,
        token: int | None = None,
        ramp: float = 0.0,
        valid_for: float = 0.0,
        guard: Guard | None = None,
        first: int = 0,
    ) -> SafeCommandSet:
        """A set that drives channels from `first` on at these shares of the test level."""
        commands = tuple(
            DriveCommand(first + number, self.frequency, share * self.level)
            for number, share in enumerate(shares)
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
        """Armed, with a watchdog that leaves time."""
        return await self.amplifier.arm(min(CALM, self.can.watchdog_max))

    async def levels(self) -> tuple[float, ...]:
        """As read back."""
        return (await self.amplifier.status()).levels

    async def expect_levels(self, *shares: float, why: str) -> None:
        """The first channels are at these shares of the test level, all others silent."""
        levels = await self.levels()
        wanted = [share * self.level for share in shares] + [0.0] * (len(levels) - len(shares))
        met = all(abs(a - b) <= LEVEL_ERROR for a, b in zip(levels, wanted, strict=True))
        expect(met, f"{why}: levels are {levels} instead of {tuple(wanted)}")

    async def until(self, reached: Callable[[Status], bool], *, what: str, feed: bool) -> Status:
        """Ask until the status is as wanted; feed: whether asking feeds the watchdog."""
        ask = self.amplifier.heartbeat if feed else self.amplifier.status
        try:
            async with asyncio.timeout(PATIENCE):
                while True:
                    status = await ask()
                    if reached(status):
                        return status
                    await asyncio.sleep(0.005)
        except TimeoutError:
            raise ContractBroken(f"{what} did not happen within {PATIENCE:g} s") from None

    async def refused(self, call: Awaitable[object], *, what: str) -> None:
        """The amplifier must say no."""
        try:
            await call
        except CommandRefused:
            return
        raise ContractBroken(f"{what} was not refused")

    async def rest(self) -> None:
        """Silent, disarmed, nothing latched."""
        await self.amplifier.stop(0.0)
        await self.until(
            lambda status: not any(status.levels), what="silence after a stop", feed=False
        )
        await self.amplifier.clear()


def expect(condition: bool, otherwise: str) -> None:
    """Raise ContractBroken with what is the case instead."""
    if not condition:
        raise ContractBroken(otherwise)
