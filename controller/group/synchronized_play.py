"""How several amplifiers play one set together: load, stage, commit at one moment, look at it."""

from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from controller.group.tasks import gather_all
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused
from drivers.guard import SafeCommandSet, SafeEnvelope
from drivers.operation.simultaneous import at_one_moment
from drivers.protocol.messages import Achieved, Status


class SynchronizedPlay:
    """Sets for amplifiers by their names in the rig; what goes wrong is raised, and left so.

    goes_on: whether anything is to be played still; silence may come in between at any step.
    is_set_incomplete: whether a set may have been committed by some of them only. loading_time [s]:
    duration of the last loading of envelopes; last_sent [s]: when the last byte of the last set
    went out to any of them, by the event loop's clock.
    """

    def __init__(self, amplifiers: Mapping[str, Amplifier], *, goes_on: Callable[[], bool]) -> None:
        self.is_set_incomplete = False
        self.loading_time = 0.0
        self.last_sent = 0.0
        self._amplifiers = amplifiers
        self._goes_on = goes_on

    def begin(self) -> None:
        """All of them are at zero."""
        self.is_set_incomplete = False

    async def play(
        self,
        commands: Mapping[str, SafeCommandSet],
        envelopes: Mapping[str, Sequence[SafeEnvelope]],
    ) -> dict[str, Achieved] | None:
        """What they make of their sets, by name; None where silence came in between.

        Raises DriverError.
        """
        if not self._goes_on():
            return None  # silence came after whatever this follows
        if any(envelopes.values()):
            begin = clock.now()
            await gather_all(self._load(name, each) for name, each in envelopes.items())
            self.loading_time = clock.now() - begin
            if not self._goes_on():
                return None  # whatever is played now would undo that silence
        if len(commands) == 1 or all(safe.is_silent for safe in commands.values()):
            # One has nobody to wait for, and silence waits for nobody.
            applied = await gather_all(
                self._amplifiers[name].apply(safe) for name, safe in commands.items()
            )
            self._note_sent()
            self.is_set_incomplete = False
            return dict(zip(commands, applied, strict=True))
        achieved = await gather_all(
            self._amplifiers[name].stage(safe) for name, safe in commands.items()
        )
        if not self._goes_on():
            return None  # a commit now would undo that silence
        self.is_set_incomplete = True
        await gather_all(self._commits(commands))
        self._note_sent()  # what is asked from here on is no part of it
        if not self._goes_on():
            return None
        for name, status in (await self.statuses()).items():
            if status.token != commands[name].token:
                raise CommandRefused(
                    f"amplifier {name} plays set {status.token} instead of {commands[name].token}"
                )
        self.is_set_incomplete = False
        return dict(zip(commands, achieved, strict=True))

    async def statuses(self) -> dict[str, Status]:
        """The status of every amplifier, by name; raises DriverError."""
        statuses = await gather_all(amplifier.status() for amplifier in self._amplifiers.values())
        return dict(zip(self._amplifiers, statuses, strict=True))

    def _note_sent(self) -> None:
        self.last_sent = max(amplifier.last_sent for amplifier in self._amplifiers.values())

    async def _load(self, name: str, envelopes: Sequence[SafeEnvelope]) -> None:
        for envelope in envelopes:
            if not self._goes_on():
                return  # nothing will be played
            await self._amplifiers[name].load_envelope(envelope)

    async def _commit(self, amplifier: Amplifier, token: int, *, for_all: bool) -> None:
        """Commit, unless silence came while this waited for those whose wires are slower."""
        if self._goes_on():
            await (amplifier.commit_on_bus(token) if for_all else amplifier.commit(token))

    def _commits(self, sets: Mapping[str, SafeCommandSet]) -> Iterable[Coroutine[Any, Any, object]]:
        """Commit everything that is staged, to arrive at one moment; once where a bus is shared."""
        together: dict[tuple[str, int], list[Amplifier]] = {}
        for name, safe in sets.items():
            amplifier = self._amplifiers[name]
            together.setdefault((amplifier.bus or name, safe.token), []).append(amplifier)
        return at_one_moment(
            [
                (one.wire_times.commit(), partial(self._commit, one, token, for_all=bool(others)))
                for (_, token), (one, *others) in together.items()
            ]
        )
