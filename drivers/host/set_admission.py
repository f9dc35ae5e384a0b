"""Sets on their way to one amplifier: each is sent only while its check by the ledger is valid."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from drivers.errors import CommandRefused, Overtaken, Preempted
from drivers.host.budget import COMMIT_DELAY
from drivers.host.identification import AmplifierIdentification
from drivers.host.ledger import Ledger
from drivers.playing import AmplifierLayer
from drivers.protocol.definition import ATTEMPTS, LAYER
from drivers.protocol.records import Values
from drivers.protocol.sets import (
    MAX_PARTS,
    PART_WORDS,
    LayerSet,
    command_words,
    is_vibrating,
    pack_layers,
    parts,
)

_CHECKED_FOR = 0.005  # s; a check holds for so long unless anything is sent or received
IsPreempted: TypeAlias = Callable[[], bool]
"""Whether something more urgent waits, so that a set that does not play yet is dropped."""


@dataclass(eq=False, slots=True)
class StagedSet:
    """A set on its way to an amplifier: requested, checked, staged, and committed."""

    requested: Sequence[AmplifierLayer]
    """Its layers as requested."""
    layers: tuple[LayerSet, ...] = ()
    """Its layers as the ledger admits them, in integers of the wire."""
    stream: Sequence[int] = ()
    """The admitted layers as words of the wire."""
    delay: float = 0.0
    """Longest time from staging until it is committed [s]."""
    checked_until: float = -math.inf
    """Until when its check is valid [s], if nothing is sent or received meanwhile."""
    exchanges: int = 0
    """Number of messages of its amplifier before its check."""
    token: int = 0
    """0 until it is staged."""
    is_immediate: bool = False
    """Whether it plays as soon as it is complete, without a commit."""
    until: float = -math.inf
    """Deadline of its commit [s]."""
    is_exact: bool = True
    """Whether the amplifier plays exactly its layers, without further rounding."""
    starts_at: float | None = None
    """When its commit starts it [s]; None or a time in the past: immediately."""


class SetAdmission:
    """The set that an amplifier may stage or commit, because its ledger has admitted it.

    name: of the amplifier, for messages.
    """

    admitted: StagedSet | None = None
    """The set that is staged and not committed yet; None after a stop, disarm or silence."""
    _exchanges: int = 0
    """Number of messages that were sent to the amplifier or received from it."""

    def __init__(self, name: str, identification: AmplifierIdentification) -> None:
        self._name = name
        self._identification = identification

    def admit(
        self,
        staged: StagedSet,
        ledger: Ledger,
        now: float,
        *,
        session: int,
        set_time: float,
        is_preempted: IsPreempted | None,
    ) -> list[Values]:
        """Admit a set with a token now, and return the values of its parts.

        set_time: how long sets to all amplifiers of the line take [s]. Raises CommandRefused, or
        Overtaken if the set is preempted.
        """
        if is_preempted is not None and is_preempted():
            raise Overtaken(f"amplifier {self._name}: set {staged.token} is preempted")
        if now > staged.checked_until or staged.exchanges != self._exchanges:
            self._check(staged, ledger, now, set_time=set_time)
        staged.until = now + staged.delay
        self.admitted = staged
        return parts(staged.stream, session=session, token=staged.token, now=staged.is_immediate)

    def refusal_of(
        self, staged: StagedSet, ledger: Ledger, now: float, *, set_time: float
    ) -> CommandRefused | None:
        """Return why the ledger would not admit a set now; None if it would.

        The set is not checked again if it is staged within 5 ms and nothing is sent or received
        meanwhile. set_time: see `admit`.
        """
        try:
            self._check(staged, ledger, now, set_time=set_time, valid_for=_CHECKED_FOR)
        except CommandRefused as error:
            return error
        return None

    def _check(
        self,
        staged: StagedSet,
        ledger: Ledger,
        now: float,
        *,
        set_time: float,
        valid_for: float = 0.0,
    ) -> None:
        """Check a set for staging within a time from now [s]; raises CommandRefused."""
        delay = max(COMMIT_DELAY, ATTEMPTS * set_time)
        words = _word_count(staged.requested)
        if words > PART_WORDS:  # parts for all amplifiers of the line, each perhaps repeated
            delay += 2 * words / PART_WORDS * set_time
        staged.layers = ledger.admit(staged.requested, now, delay=delay + valid_for)
        staged.stream = pack_layers(staged.layers)
        if not self._identification.is_complete and is_vibrating(*staged.layers):
            raise CommandRefused(f"amplifier {self._name} must be identified first; open it again")
        max_words = min(ledger.capabilities["set_words"], MAX_PARTS * PART_WORDS)
        if len(staged.stream) > max_words:
            raise CommandRefused(
                f"a set must have at most {max_words} words, got {len(staged.stream)}"
            )
        staged.delay = delay
        staged.checked_until = now + valid_for
        staged.exchanges = self._exchanges

    def check(self, token: int, now: float, *, may_be_late: bool) -> None:
        """Raise Preempted or CommandRefused unless the set with a token may be sent now.

        may_be_late: whether it may be sent even when its check is no longer valid.
        """
        admitted = self.admitted
        if admitted is None or admitted.token != token:
            raise Preempted(f"amplifier {self._name}: a stop, disarm or newer set came first")
        if now > admitted.until and not may_be_late:
            raise CommandRefused(
                f"amplifier {self._name}: set {token} must be committed "
                f"{now - admitted.until:.3g} s earlier; the wire is too slow or too busy",
                until=now,
            )

    def note_exchange(self) -> None:
        """Note that something was sent or received, which ends the validity of all checks."""
        self._exchanges += 1

    def withdraw(self) -> None:
        """Let the staged set not be committed, because the amplifier is silenced or armed."""
        self.admitted = None

    def note_committed(self, token: int) -> None:
        """Note that the amplifier has committed the set with a token."""
        if self.admitted is not None and self.admitted.token == token:
            self.admitted = None


def _word_count(layers: Sequence[AmplifierLayer]) -> int:
    """Return how many words layers have on the wire."""
    words = LAYER.words * len(layers)
    for layer in layers:
        for tone in layer.tones:
            envelopes = (tone.onset, tone.ending)
            words += command_words([len(shape.knots) for shape in envelopes if shape is not None])
    return words
