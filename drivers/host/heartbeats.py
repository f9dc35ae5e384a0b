"""Heartbeats of armed amplifiers, which show as well that they still play what they should.

A watchdog that runs down, and starts anew with each heartbeat, shows that it would silence the
amplifier: so its status is read just before it is fed. One that does not reply is not fed.
"""

import asyncio

from drivers import clock
from drivers.errors import LinkTimeout
from drivers.host.amplifier import Amplifier
from drivers.host.jobs import Priority
from drivers.host.members import Members, is_lost, seen
from drivers.protocol.records import Values

_MAX_STATUS_LOAD = 0.05  # of the line's time, for statuses that show whether the watchdog runs down


class Heartbeats:
    """Heartbeats of the amplifiers of a group."""

    def __init__(self, members: Members) -> None:
        self._members = members
        self._running_read_at: dict[str, float] = {}
        self._readings: dict[str, asyncio.Future[Values]] = {}  # of amplifiers that do not reply

    async def beat(self) -> None:
        """Feed the watchdog of every amplifier that replies, and read the status of the others.

        Raises LinkTimeout where one is lost, Preempted where they are armed no longer, and what
        the requests raise.
        """
        amplifiers = self._members.amplifiers.values()
        for amplifier in amplifiers:  # before the others are waited for: they are stopped then
            if is_lost(amplifier):
                self._members.lose()
                raise LinkTimeout(amplifier.line.loss or amplifier.silence_cause)
        before = self._members.silences
        await self._members.all([self._beat(each, before) for each in amplifiers])

    async def _beat(self, amplifier: Amplifier, before: int) -> None:
        name = amplifier.name
        if amplifier.silence_cause is None:
            # A status just before the watchdog is fed, unless the wire is too slow for that.
            pause = amplifier.exchange_time("Set") / _MAX_STATUS_LOAD
            if (now := clock.now()) - self._running_read_at.get(name, 0.0) >= pause:
                self._running_read_at[name] = now
                await amplifier.read_status(Priority.HEARTBEAT)
            self._members.check_none_since(before)
            await amplifier.ping()
        elif name not in self._readings or self._readings[name].done():
            reading = asyncio.ensure_future(amplifier.read_status(Priority.READING))
            reading.add_done_callback(seen)
            self._readings[name] = reading
