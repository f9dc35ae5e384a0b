"""Who of a group is fed, when and by what: the only place that decides it.

A watchdog that runs down, and starts anew with each heartbeat, shows that it would silence its
amplifier: so its status is read just before it is fed, five times a second, and less often on a
slow wire or where replies come late. On a line whose replies come late each exchange may take a
third of a watchdog: there all are fed ahead of what is sent to one.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import TypeAlias

from drivers.errors import LinkTimeout
from drivers.host.amplifier import Amplifier
from drivers.host.clocks import Clocks
from drivers.host.jobs import Make, Priority
from drivers.host.joint_sets import JointSets
from drivers.host.line import GRACE, Line
from drivers.host.members import Members, is_lost
from drivers.host.moments import word_passed_by_all
from drivers.protocol.definition import HEARTBEAT
from drivers.protocol.records import Values
from drivers.protocol.sets import is_newer_token, token_after

_STATUS_INTERVAL = 0.19  # s at least, between statuses that show if the watchdog runs down
_MAX_STATUS_LOAD = 0.05  # of the line's time, for these
_UNFED = 1.5 * HEARTBEAT  # s; beside a set to each, longest time between feedings of one

Feed: TypeAlias = Callable[[], Awaitable[object]]
"""What feeds an amplifier."""


class Heartbeats:
    """Feeds the watchdogs of a group. restored: called where one that was mute replies again."""

    def __init__(
        self, members: Members, sets: JointSets, clocks: Clocks, restored: Callable[[], None]
    ) -> None:
        self._members, self._sets, self._restored = members, sets, restored
        self._clocks = clocks
        self._running_due: dict[Amplifier, float] = {}  # statuses just before a heartbeat
        self._readings: dict[Amplifier, asyncio.Future[Values]] = {}  # of those that are mute

    def follow(self) -> None:
        """Know those of a line from now on, who are fed ahead of one's sets."""
        every = self._members.amplifiers.values()
        for line in self._members.lines:
            of_line = [each for each in every if each.line is line]
            line.ahead = partial(self._ahead, line, of_line) if len(of_line) > 1 else None

    def beat(self) -> Awaitable[Sequence[object]]:
        """Feed every amplifier that replies, and read the status of any other meanwhile.

        One that has committed nothing since it was armed is fed by an empty set on a line that it
        shares, so that all have committed the same: the line feeds them together by that.
        A status shows how a watchdog runs down only if it is read before any of its line are fed.
        On a line that is slow or late of one alone, so that none waits for long; of none where one
        may reply again, which is to be heard before.
        """
        by_line: dict[Line, list[Amplifier]] = {}
        mute: set[Line] = set()
        for each in self._members.by_need:
            if (each.silence_cause or each.line.loss) and is_lost(each):
                # Before the others are waited for: they stop then.
                raise LinkTimeout(each.line.loss or each.silence_cause)
            by_line.setdefault(each.line, []).append(each)
            if each.silence_cause is not None:
                mute.add(each.line)
        self._clocks.look({line: by_line[line] for line in by_line if line not in mute})
        feeds: list[Feed] = []
        for line, of_line in by_line.items():
            may_read, token = line not in mute, 0
            is_late, is_shared, now = line.late > GRACE, len(line.members) > 1, line.time()
            for each in of_line:
                if each.silence_cause is not None:
                    self._listen(each)
                    continue
                feed: Feed = each.ping
                due = self._running_due.get(each, 0.0)
                if is_shared and not each.committed:
                    token = token or self._first_token(of_line)
                    feed = partial(each.stage, token, (), now=True, priority=Priority.HEARTBEAT)
                elif may_read and now >= due and each.feeding.tells(now):
                    due = now + max(each.exchange_time("Set") / _MAX_STATUS_LOAD, _STATUS_INTERVAL)
                    self._running_due[each] = due
                    all_of_line = 2 * each.exchange_time("GetStatus") * len(line.members)
                    may_read = not is_late and all_of_line <= HEARTBEAT
                    reading = each.read_status(Priority.HEARTBEAT)
                    feed = partial(self._feed_after, each, self._members.epoch, reading)
                elif is_late and not each.clock.is_alone:  # heartbeats alone are readings of it
                    pause = asyncio.sleep(self._clocks.later())
                    feed = partial(self._feed_after, each, self._members.epoch, pause)
                feeds.append(feed)
        return self._members.all([feed() for feed in feeds])

    def _first_token(self, of_line: Sequence[Amplifier]) -> int:
        """Return the token that one of a line has committed, or else a new one."""
        committed = max([each.committed for each in of_line])
        if not committed:
            self._sets.token = token_after(self._sets.token)
        return committed or self._sets.token

    async def _feed_after(
        self, amplifier: Amplifier, before: int, awaited: Awaitable[object]
    ) -> Values:
        """Feed one after a reading or a pause, unless a stop or disarm came since an epoch."""
        await awaited
        self._members.check_none_since(before)
        return await amplifier.ping()

    def _listen(self, amplifier: Amplifier) -> None:
        """Read the status of one that is mute, until it replies or is lost."""
        reading = self._readings.get(amplifier)
        if reading is None or reading.done():
            read = partial(amplifier.read_status, Priority.READING)
            reading = asyncio.ensure_future(self._members.retried(amplifier, read))
            reading.add_done_callback(self._has_replied)
            self._readings[amplifier] = reading

    def _has_replied(self, reading: "asyncio.Future[Values]") -> None:
        if not reading.cancelled() and reading.exception() is None:
            self._restored()

    def _ahead(
        self, line: Line, of_line: Sequence[Amplifier], name: str, priority: Priority
    ) -> Make | None:
        """Return what feeds all of a line ahead of a request of the control loop to one.

        Where one was surely fed long ago. By a commit of the newest token: it changes nothing on
        those that have committed it, and the others may have their commit now. Not ahead of a
        status: it shows how a watchdog runs down only if none was fed before it.
        """
        if priority not in (Priority.HEARTBEAT, Priority.SET) or name == "GetStatus":
            return None
        limit = HEARTBEAT
        if line.late <= GRACE:
            limit = _UNFED + sum([each.exchange_time("Set") for each in of_line])
        if line.time() - min([each.feeding.since for each in of_line]) <= limit:
            return None
        session, token = of_line[0].session, 0
        for each in of_line:
            if each.committed and is_newer_token(each.committed, token):
                token = each.committed
        if not token or any(each.session != session for each in of_line):
            return None

        def make() -> list[Values]:
            values = {
                "session": session,
                "token": token,
                "at": word_passed_by_all(line.time(), of_line),
            }
            for each in of_line:
                each.next_request("Commit", values, Priority.SET)
            return [values]

        return make
