"""Playing one set on several amplifiers: load, stage, commit at one moment, read the tokens."""

import math
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from controller.group.tasks import gather_all
from drivers import clock
from drivers.guard import SafeCommandSet, SafeEnvelope
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.simultaneous import simultaneous_commits
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


class SynchronizedPlay:
    """Plays sets on amplifiers, by name, so that all of them start at one moment.

    is_set_incomplete: whether possibly only some amplifiers have committed the last set.
    """

    def __init__(self, amplifiers: Mapping[str, CheckedAmplifier]) -> None:
        self.is_set_incomplete = False
        self._amplifiers = amplifiers

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
            achieved = await gather_all(
                self._amplifiers[name].apply(safe) for name, safe in sets.items()
            )
            sent_at = self._last_sent_at
        else:
            achieved = await gather_all(
                self._amplifiers[name].stage(safe) for name, safe in sets.items()
            )
            if not may_play():
                return None  # as above
            self.is_set_incomplete = True
            committed_at = clock.now()
            for name, safe in sets.items():
                self._amplifiers[name].expect_commit(safe)
            await gather_all(self._commits(sets, may_play))
            sent_at = self._last_sent_at  # before the statuses are read
            if not may_play():
                return None
            await self._confirm_commits(sets, committed_at)
        self.is_set_incomplete = False
        return Played(dict(zip(sets, achieved, strict=True)), sent_at, loading_time)

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

    def _commits(
        self, sets: Mapping[str, SafeCommandSet], may_play: Callable[[], bool]
    ) -> Iterable[Coroutine[Any, Any, object]]:
        """Commit all staged sets so that they arrive at one moment; once for each shared bus."""
        by_bus: dict[tuple[str, int], list[str]] = {}
        for name, safe in sets.items():
            amplifier = self._amplifiers[name].amplifier
            takes_broadcasts = Feature.BROADCAST in amplifier.capabilities.features
            bus = (amplifier.bus if takes_broadcasts else None) or name
            by_bus.setdefault((bus, safe.token), []).append(name)
        return simultaneous_commits(
            [
                (
                    self._amplifiers[first].amplifier.wire_times.commit(),
                    partial(
                        _commit,
                        self._amplifiers[first],
                        sets[first],
                        on_bus=bool(others),
                        may_play=may_play,
                    ),
                )
                for first, *others in by_bus.values()
            ]
        )

    async def _confirm_commits(
        self, sets: Mapping[str, SafeCommandSet], committed_at: float
    ) -> None:
        """Raise CommandRefused unless every amplifier reports that it plays its set."""
        await gather_all(
            self._amplifiers[name].confirm_commit(safe, sent_at=committed_at)
            for name, safe in sets.items()
        )


async def _commit(
    checked: CheckedAmplifier,
    safe: SafeCommandSet,
    *,
    on_bus: bool,
    may_play: Callable[[], bool],
) -> None:
    """Commit, unless silence came while this waited for an amplifier on a slower wire."""
    if not may_play():
        return
    if on_bus:
        await checked.amplifier.commit_on_bus(safe.token)
    else:
        await checked.commit(safe)
