"""Arming of all amplifiers of a group, or of none: any silence that is asked for comes first."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from drivers.errors import CommandRefused, DriverError, LinkDegraded, LinkError, Preempted
from drivers.host.amplifier import STOP_RAMP, Amplifier
from drivers.host.members import Members, retried, to_completion


class Silences:
    """Stops, disarms and closes of a group: how many were asked for, and how many last."""

    def __init__(self) -> None:
        self.count = 0
        """Stops, disarms and closes so far."""
        self._lasting = 0

    def __bool__(self) -> bool:
        """Whether a stop or disarm is in progress."""
        return self._lasting > 0

    @contextmanager
    def in_progress(self) -> Iterator[None]:
        """Refuse arming and clearing meanwhile."""
        self._lasting += 1
        try:
            yield
        finally:
            self._lasting -= 1

    def check_none_since(self, before: int) -> None:
        """Raise Preempted if one was asked for since the count was this."""
        if self.count != before:
            raise Preempted(
                "amplifiers were disarmed, stopped or closed while arming, and stay disarmed; "
                "arm again if that is still wanted"
            )


class Arming:
    """Arms the amplifiers of a group; stop: of all of them, where one cannot be disarmed."""

    def __init__(
        self, members: Members, silences: Silences, stop: Callable[[], Awaitable[object]]
    ) -> None:
        self._members = members
        self._silences = silences
        self._stop = stop

    async def arm(self, session: int, watchdog: float, *, before: int) -> None:
        """Arm all amplifiers under one session; where one fails those that may be are disarmed.

        watchdog [s]. before: count of silences at the request. Raises DriverError, LinkDegraded
        where one only does not reply for now.
        """
        amplifiers = [*self._members.amplifiers.values()]
        arming = asyncio.gather(
            *[each.arm(session, watchdog) for each in amplifiers], return_exceptions=True
        )
        try:
            self._members.checked(await asyncio.shield(arming))
            self._silences.check_none_since(before)
        except BaseException as error:
            self._members.note(error)
            with self._silences.in_progress():
                await to_completion(self._disarm_armed(amplifiers, arming))
            if isinstance(error, DriverError):
                self._silences.check_none_since(before)
            if self._members.is_degraded_only(error):
                raise LinkDegraded(str(error)) from error
            if self._members.lost_by:
                self._members.lost()
            raise

    async def _disarm_armed(
        self, amplifiers: Sequence[Amplifier], arming: "asyncio.Future[list[Any]]"
    ) -> None:
        """Disarm what may have been armed by this; one that has refused may be another host's."""
        results = await arming
        disarmed = await asyncio.gather(
            *[
                retried(each, partial(each.disarm, STOP_RAMP))
                for each, result in zip(amplifiers, results, strict=True)
                if not isinstance(result, CommandRefused)
                or isinstance(result, Preempted)
                or result.may_play
            ],
            return_exceptions=True,
        )
        failures = [each for each in disarmed if isinstance(each, BaseException)]
        if not all(isinstance(each, LinkError) for each in failures):  # a mute one stops none
            await self._stop()
