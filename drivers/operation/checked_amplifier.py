"""An amplifier whose replies are compared with its requests while it is armed."""

import math
from collections.abc import Callable

from drivers import clock
from drivers.amplifier import WATCHDOG, Amplifier
from drivers.errors import CommandRefused
from drivers.guard import SafeCommandSet
from drivers.operation.plausibility import PlausibilityCheck
from drivers.protocol.messages import Achieved, Status

_MAX_STATUS_LOAD = 0.05
"""Fraction of the line's time for statuses that show whether the watchdog runs down."""


class CheckedAmplifier:
    """Arms, plays and feeds an open amplifier; arguments as `PlausibilityCheck`.

    Raises CommandRefused if its replies contradict requests twice in a row
    (`PlausibilityCheck`) or it is no longer enabled, and the errors of `Amplifier`.
    """

    def __init__(self, amplifier: Amplifier, name: str = "the amplifier") -> None:
        self.amplifier = amplifier
        self._name = name
        self._check_if_used: PlausibilityCheck | None = None
        self._running_checked_at = -math.inf

    async def arm(self, watchdog: float = WATCHDOG, *, session: int | None = None) -> Status:
        """Arm with a watchdog [s]; what was expected before is forgotten."""
        started_at = clock.now()
        status = await self.amplifier.arm(watchdog, session=session)
        check = self._new_check()
        check.expect_armed(watchdog, sent_at=started_at, now=clock.now())
        self._check_if_used = check
        return status

    async def apply(self, safe: SafeCommandSet) -> Achieved:
        """Play a set once there is room for it; returns the achieved set."""
        await self.amplifier.wait_for_room(safe)
        check, started_at = self._check, clock.now()
        check.forget(safe)
        achieved = await self.amplifier.apply(safe)
        check.expect(safe, sent_at=started_at, now=clock.now())
        check.check_achieved(safe, achieved)
        return achieved

    async def stage(self, safe: SafeCommandSet) -> Achieved:
        """Keep a set ready under its token; returns what its commit would achieve."""
        check = self._check
        achieved = await self.amplifier.stage(safe)
        check.check_achieved(safe, achieved)
        return achieved

    async def commit(self, safe: SafeCommandSet) -> None:
        """Play the staged set."""
        check = self._check
        check.check_achieved(safe, await self.amplifier.commit(safe.token))

    def expect_commit(self, safe: SafeCommandSet) -> None:
        """Expect that a staged set may play from now on."""
        self._check.forget(safe)

    async def confirm_commit(self, safe: SafeCommandSet, *, sent_at: float) -> None:
        """Confirm by a status that a committed set plays; sent_at [s]: of its commit.

        Raises CommandRefused if it does not.
        """
        check, started_at = self._check, clock.now()
        status = await self.amplifier.status()
        if status.token != safe.token:
            raise CommandRefused(
                f"{self._name}: playing set must be {safe.token}, got {status.token}; clear and "
                "arm again"
            )
        check.expect(safe, sent_at=sent_at, now=clock.now())
        check.check_status(status, sent_at=started_at, now=clock.now())

    async def heartbeat(self, *, may_feed: Callable[[], bool] = lambda: True) -> Status | None:
        """Feed the watchdog; on a degraded link only once the amplifier has replied as expected.

        may_feed: called just before; returns None if it is false.
        """
        if self.amplifier.is_degraded:
            status = await self._beat()
            if self.amplifier.is_degraded:
                return status
        else:
            await self._check_running(self._check)
        return await self._beat() if may_feed() else None

    async def _beat(self) -> Status:
        """Send a heartbeat and compare the status."""
        check, started_at, feeds = self._check, clock.now(), not self.amplifier.is_degraded
        status = await self.amplifier.heartbeat()
        check.check_status(status, sent_at=started_at, now=clock.now(), feeds=feeds)
        return status

    async def _check_running(self, check: PlausibilityCheck) -> None:
        """Read a status just before the watchdog is fed, unless the wire is too slow for that."""
        started_at, fed = clock.now(), self.amplifier.last_fed_at
        pause = self.amplifier.round_trip() / _MAX_STATUS_LOAD
        if fed is None or started_at - self._running_checked_at < pause:
            return
        self._running_checked_at = started_at
        status = await self.amplifier.status()
        check.check_running(status, sent_at=started_at, last_fed_at=fed)

    @property
    def _check(self) -> PlausibilityCheck:
        if self._check_if_used is None:
            self._check_if_used = self._new_check()
        return self._check_if_used

    def _new_check(self) -> PlausibilityCheck:
        return PlausibilityCheck(self.amplifier.capabilities, self._name)
