"""Heartbeats, which feed the watchdogs of all amplifiers of a group.

Only `Heartbeats` decides which amplifier is fed, when, and by which request. A status read just
before a heartbeat shows that the watchdog is running down, and so would silence its amplifier. Such
a status is read five times a second, less often on a slow wire or with late replies. If replies are
so late that one exchange takes a third of a watchdog, all amplifiers of a line are fed before each
request on that line.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import TypeAlias

from drivers.errors import LinkTimeout
from drivers.host.amplifier import Amplifier
from drivers.host.group_clocks import Clocks
from drivers.host.joint_sets import JointSets, commit_of, word_passed_by_all
from drivers.host.line import Line
from drivers.host.members import Members, is_lost
from drivers.host.requests import GRACE, Make, Priority
from drivers.host.set_admission import StagedSet
from drivers.protocol.definition import HEARTBEAT, REQUESTS
from drivers.protocol.records import Values
from drivers.protocol.sets import is_newer_token

_STATUS_INTERVAL = 0.19  # s; at least, between two statuses that show whether the watchdog runs
_MAX_STATUS_LOAD = 0.05  # share of the line's time that these statuses may take
_UNFED = 1.5 * HEARTBEAT  # s; longest time without feeding, in addition to a set to each amplifier

Feed: TypeAlias = Callable[[], Awaitable[object]]
"""A function that sends the request that feeds an amplifier."""


class Heartbeats:
    """Feeds the watchdogs of a group; calls `restored` when a mute amplifier replies again."""

    def __init__(
        self, members: Members, sets: JointSets, clocks: Clocks, restored: Callable[[], None]
    ) -> None:
        self._members = members
        self._sets = sets
        self._clocks = clocks
        self._restored = restored
        self._running_due: dict[Amplifier, float] = {}
        """When the next status is read before a heartbeat [s]."""
        self._readings: dict[Amplifier, asyncio.Future[Values]] = {}
        """The last status request to each mute amplifier."""

    def follow(self) -> None:
        """Make each shared line feed all its amplifiers before a set to one amplifier."""
        amplifiers = self._members.amplifiers.values()
        for line in self._members.lines:
            line_amplifiers = [amplifier for amplifier in amplifiers if amplifier.line is line]
            line.ahead = None
            if len(line_amplifiers) > 1:
                line.ahead = partial(self._ahead, line, line_amplifiers)

    def beat(self) -> Awaitable[Sequence[object]]:
        """Feed every amplifier that replies, and read the status of each mute one meanwhile.

        On a shared line, an amplifier that has committed nothing since it was armed is fed by an
        empty set; then all have committed the same token, and a broadcast commit feeds them all.
        A status shows how a watchdog runs down only if it is read before any amplifier of its line
        is fed. On a slow or late line, one such status is read at a time, so that no amplifier
        waits for long; on a line with a mute amplifier, none is read, since that amplifier must be
        heard first.
        """
        by_line: dict[Line, list[Amplifier]] = {}
        mute_lines: set[Line] = set()
        for amplifier in self._members.by_last_feeding:
            line = amplifier.line
            if (amplifier.no_reply_cause or line.loss) and is_lost(amplifier):
                # Raised before awaiting the others, so that they are stopped immediately.
                raise LinkTimeout(line.loss or amplifier.no_reply_cause)
            by_line.setdefault(line, []).append(amplifier)
            if amplifier.no_reply_cause is not None:
                mute_lines.add(line)
        self._clocks.look({line: by_line[line] for line in by_line if line not in mute_lines})
        feeds: list[Feed] = []
        for line, line_amplifiers in by_line.items():
            feeds += self._feeds_of(line, line_amplifiers, may_read=line not in mute_lines)
        return self._members.all([feed() for feed in feeds])

    def _feeds_of(
        self, line: Line, line_amplifiers: Sequence[Amplifier], *, may_read: bool
    ) -> list[Feed]:
        """Return what feeds the amplifiers of a line that reply, and listen to the others.

        may_read: whether a status may be read first, to show how the watchdog runs down.
        """
        is_late = line.late > GRACE
        is_shared = len(line.members) > 1
        now = line.time()
        epoch = self._members.epoch
        token = 0
        feeds: list[Feed] = []
        for amplifier in line_amplifiers:
            if amplifier.no_reply_cause is not None:
                self._listen(amplifier)
                continue
            feed: Feed = amplifier.ping
            due = self._running_due.get(amplifier, 0.0)
            if is_shared and not amplifier.committed:
                token = token or self._first_token(line_amplifiers)
                feed = partial(
                    amplifier.stage,
                    StagedSet(()),
                    token,
                    now=True,
                    priority=Priority.HEARTBEAT,
                )
            elif may_read and now >= due and amplifier.feeding.is_shown_by(now):
                interval = amplifier.exchange_time("Set") / _MAX_STATUS_LOAD
                self._running_due[amplifier] = now + max(interval, _STATUS_INTERVAL)
                statuses_time = 2 * amplifier.exchange_time("GetStatus") * len(line.members)
                may_read = not is_late and statuses_time <= HEARTBEAT
                reading = amplifier.read_status(Priority.HEARTBEAT)
                feed = partial(self._feed_after, amplifier, epoch, reading)
            elif is_late and not amplifier.clock.is_alone:  # only heartbeats read this clock
                pause = asyncio.sleep(self._clocks.later())
                feed = partial(self._feed_after, amplifier, epoch, pause)
            feeds.append(feed)
        return feeds

    def _first_token(self, line_amplifiers: Sequence[Amplifier]) -> int:
        """Return the token that an amplifier of a line has committed, or else a new one."""
        committed = max([amplifier.committed for amplifier in line_amplifiers])
        return committed or self._sets.next_token()

    async def _feed_after(
        self, amplifier: Amplifier, epoch: int, awaited: Awaitable[object]
    ) -> Values:
        """Feed an amplifier after a reading or a pause, unless a stop or disarm came meanwhile.

        epoch: the epoch when this was decided.
        """
        await awaited
        self._members.check_none_since(epoch)
        return await amplifier.ping()

    def _listen(self, amplifier: Amplifier) -> None:
        """Read the status of a mute amplifier until it replies or is lost."""
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
        self, line: Line, line_amplifiers: Sequence[Amplifier], name: str, priority: Priority
    ) -> Make | None:
        """Return a function that feeds a line before a request to an amplifier; None if not needed.

        Needed if the last certain feeding of an amplifier was long ago. It commits the newest token
        again, which changes nothing on amplifiers that have committed it, and is due on the others
        anyway. Nothing is fed before a status, which would then not show the watchdog running down.
        """
        is_routine = priority in (Priority.HEARTBEAT, Priority.SET)
        if not is_routine or REQUESTS[name].shows_watchdog:
            return None
        limit = HEARTBEAT
        if line.late <= GRACE:
            limit = _UNFED + sum([amplifier.exchange_time("Set") for amplifier in line_amplifiers])
        if line.time() - min([amplifier.feeding.fed_at for amplifier in line_amplifiers]) <= limit:
            return None
        session = line_amplifiers[0].session
        token = 0
        for amplifier in line_amplifiers:
            if amplifier.session != session:
                return None
            if amplifier.committed and is_newer_token(amplifier.committed, token):
                token = amplifier.committed
        if not token:
            return None
        return partial(_repeated_commit, line_amplifiers, token)


def _repeated_commit(line_amplifiers: Sequence[Amplifier], token: int) -> list[Values]:
    """Return a commit that starts immediately; raises unless all amplifiers allow it."""
    at = word_passed_by_all(line_amplifiers[0].line.time(), line_amplifiers)
    return commit_of(line_amplifiers, token, at)
