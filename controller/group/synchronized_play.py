"""Playing one set on several amplifiers: load, stage, commit at one moment, read the tokens."""

import math
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from controller.group.joint_start import JointStart
from controller.group.tasks import gather_all
from drivers import clock
from drivers.guard import SafeCommandSet, SafeEnvelope
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.simultaneous import commit_at
from drivers.operation.watchdog import HEARTBEAT
from drivers.protocol.messages import Achieved, Feature


@dataclass(frozen=True)
class Played:
    """Sets that amplifiers play, by name.

    sent_at [s]: when the last byte of the set left for any amplifier, by the event loop's clock;
    loading_time [s]: how long loading the envelopes before it took, None without envelopes.
    is_late: whether loading was given up, since it would have taken too long: nothing was played.
    """

    achieved: Mapping[str, Achieved]
    sent_at: float
    loading_time: float | None
    is_late: bool = False


_Started: TypeAlias = tuple[dict[str, Achieved], float]
"""What amplifiers achieve, by name, and when [s] their commit had left."""


class SynchronizedPlay:
    """Plays sets on amplifiers, by name, so that all of them start at one moment.

    is_set_incomplete: whether possibly only some amplifiers have committed the last set.
    """

    def __init__(self, amplifiers: Mapping[str, CheckedAmplifier]) -> None:
        self.is_set_incomplete = False
        self._amplifiers = amplifiers
        self._started_at = 0.0  # s; when the last sets began to be committed

    def forget(self) -> None:
        """Forget what was played: the amplifiers are armed anew, and silent."""
        self.is_set_incomplete = False

    async def play(
        self,
        sets: Mapping[str, SafeCommandSet],
        envelopes: Mapping[str, Sequence[SafeEnvelope]],
        *,
        may_play: Callable[[], bool],
        load_until: float = math.inf,
    ) -> Played | None:
        """Load the envelopes and play the sets; None if `may_play` is False between steps.

        load_until [s]: when all envelopes must be loaded. Raises DriverError, and leaves the
        amplifiers as they are then.
        """
        if not may_play():
            return None
        loading_time = None
        if any(envelopes.values()):
            start = clock.now()
            in_time = await gather_all(
                self._load(name, several, may_play, load_until)
                for name, several in envelopes.items()
            )
            loading_time = clock.now() - start
            if not may_play():
                return None  # playing now would undo the silence that came meanwhile
            if not all(in_time):
                return Played({}, start, loading_time, is_late=True)
        is_silence = all(safe.is_silent for safe in sets.values())
        if len(sets) == 1 or is_silence or not self._can_stage:
            # A single amplifier needs no staging, and silence is not delayed by it.
            self.is_set_incomplete = self.is_set_incomplete or (len(sets) > 1 and not is_silence)
            replies = await gather_all(
                self._amplifiers[name].apply(safe) for name, safe in sets.items()
            )
            achieved = dict(zip(sets, replies, strict=True))
            sent_at = self._last_sent_at
        else:
            starts = await gather_all(self._starts(sets, may_play))
            started = [each for each in starts if each is not None]
            if len(started) < len(starts):
                return None  # as above
            achieved = {name: each for several, _ in started for name, each in several.items()}
            sent_at = max(moment for _, moment in started)
        self.is_set_incomplete = False
        return Played(achieved, sent_at, loading_time)

    @property
    def _can_stage(self) -> bool:
        """Whether all amplifiers stage sets, so that they can start together."""
        return all(
            Feature.STAGING in each.amplifier.capabilities.features
            for each in self._amplifiers.values()
        )

    @property
    def _last_sent_at(self) -> float:
        return max(each.amplifier.last_sent_at for each in self._amplifiers.values())

    async def _load(
        self,
        name: str,
        envelopes: Sequence[SafeEnvelope],
        may_play: Callable[[], bool],
        until: float,
    ) -> bool:
        """Load envelopes one after the other; False once those left would not be in time [s].

        They do not feed the watchdog: a heartbeat that is due meanwhile is sent between them.
        """
        checked = self._amplifiers[name]
        start = clock.now()
        for number, envelope in enumerate(envelopes):
            now = clock.now()
            each = (now - start) / number if number else 0.0
            if now + each * (len(envelopes) - number) > until:
                return False
            if now - (checked.amplifier.last_fed_at or now) >= HEARTBEAT:
                await checked.heartbeat(may_feed=may_play)
            if may_play():
                await checked.amplifier.load_envelope(envelope)
        return True

    def _starts(
        self, sets: Mapping[str, SafeCommandSet], may_play: Callable[[], bool]
    ) -> list[Coroutine[Any, Any, _Started | None]]:
        """Stage all sets and start them so that their commits arrive at one moment."""
        by_bus: dict[tuple[str, int], dict[str, SafeCommandSet]] = {}
        for name, safe in sets.items():
            amplifier = self._amplifiers[name].amplifier
            takes_broadcasts = Feature.BROADCAST in amplifier.capabilities.features
            bus = (amplifier.bus if takes_broadcasts else None) or name
            by_bus.setdefault((bus, safe.token), {})[name] = safe
        firsts = [self._amplifiers[next(iter(sharing))] for sharing in by_bus.values()]
        takes = [first.amplifier.wire_times.commit() for first in firsts]
        start = JointStart(len(takes), partial(self._start_commits, sets, may_play))
        return [
            self._start(sharing, start, may_play, delay=max(takes) - each)
            for sharing, each in zip(by_bus.values(), takes, strict=True)
        ]

    def _start_commits(
        self, sets: Mapping[str, SafeCommandSet], may_play: Callable[[], bool]
    ) -> bool:
        """Begin to commit staged sets, unless silence came first."""
        if not may_play():
            return False
        self.is_set_incomplete = True
        self._started_at = clock.now()
        for name, safe in sets.items():
            self._amplifiers[name].expect_commit(safe)
        return True

    async def _start(
        self,
        sets: Mapping[str, SafeCommandSet],
        start: JointStart,
        may_play: Callable[[], bool],
        *,
        delay: float,
    ) -> _Started | None:
        """Start the set of one amplifier, or those of a bus at once, when all are staged.

        delay [s]: of the commit, so that it arrives together with that of the slowest wire. Returns
        what is achieved and when [s] the commit had left; None if silence came before the end.
        Raises CommandRefused unless every amplifier reports that it plays its set.
        """
        several = {name: self._amplifiers[name] for name in sets}
        try:
            achieved = await gather_all(
                checked.stage(sets[name]) for name, checked in several.items()
            )
        except BaseException:
            start.fail()
            raise
        if not await start.ready():
            return None
        started_at = self._started_at
        commit = partial(_commit, [*several.values()], [*sets.values()], may_play)
        if not await commit_at(started_at + delay, commit):
            return None
        sent_at = next(iter(several.values())).amplifier.last_sent_at
        if not may_play():
            return None
        await gather_all(
            checked.confirm_commit(sets[name], sent_at=started_at)
            for name, checked in several.items()
        )
        return dict(zip(sets, achieved, strict=True)), sent_at


async def _commit(
    several: Sequence[CheckedAmplifier],
    sets: Sequence[SafeCommandSet],
    may_play: Callable[[], bool],
) -> bool:
    """Commit; false if silence came while this waited for an amplifier on a slower wire."""
    if not may_play():
        return False
    if len(several) > 1:
        first, *others = (checked.amplifier for checked in several)
        await first.commit_on_bus(sets[0].token, others)
    else:
        await several[0].commit(sets[0])
    return True
