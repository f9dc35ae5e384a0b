"""Admission of sets to one amplifier: a set is sent only while its check by the ledger is valid."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from drivers.errors import CommandRefused, Overtaken, Preempted
from drivers.host.bounds import COMMIT_DELAY
from drivers.host.identification import AmplifierIdentification
from drivers.host.ledger import Ledger, StagedSet
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


@dataclass(frozen=True, slots=True)
class _CheckedSet:
    """Layers that the ledger admits, ready to be staged."""

    layers: Sequence[AmplifierLayer]
    """The layers as requested."""
    admitted: tuple[LayerSet, ...]
    """The layers as admitted."""
    stream: list[int]
    """The admitted layers as words of the wire."""
    delay: float
    """Longest time from staging until they are committed [s]."""
    valid_until: float
    """Until when the check is valid [s], if nothing is sent or received meanwhile."""


@dataclass
class SetRequest:
    """A set that is checked when its turn on the line comes."""

    token: int
    layers: Sequence[AmplifierLayer]
    now: bool
    """Whether it plays immediately."""
    is_preempted: IsPreempted | None
    staged: StagedSet | None = None
    """The set as it was made last."""


class SetAdmission:
    """The set that an amplifier may stage or commit, because its ledger has admitted it.

    name: of the amplifier, for messages.
    """

    admitted: StagedSet | None = None
    """The set that is staged and not committed yet; None after a stop, disarm or silence."""
    _checked: _CheckedSet | None = None
    """The layers that were checked last, if this check can be used again."""

    def __init__(self, name: str, identification: AmplifierIdentification) -> None:
        self._name = name
        self._identification = identification

    def admit(
        self, request: SetRequest, ledger: Ledger, now: float, *, session: int, set_time: float
    ) -> list[Values]:
        """Admit a set now, and return the values of its parts.

        set_time: how long sets to all amplifiers of the line take [s]. Raises CommandRefused, or
        Overtaken if the set is preempted.
        """
        token = request.token
        if request.is_preempted is not None and request.is_preempted():
            raise Overtaken(f"amplifier {self._name}: set {token} is preempted")
        checked = self._checked
        if checked is None or checked.layers is not request.layers or now > checked.valid_until:
            checked = self._check(request.layers, ledger, now, set_time=set_time)
        self._checked = None
        messages = parts(checked.stream, session=session, token=token, now=request.now)
        request.staged = StagedSet(token, checked.admitted, True, until=now + checked.delay)
        self.admitted = request.staged
        return messages

    def refusal_of(
        self, layers: Sequence[AmplifierLayer], ledger: Ledger, now: float, *, set_time: float
    ) -> CommandRefused | None:
        """Return why the ledger would not admit layers now; None if it would.

        The result is used again if the layers are admitted within 5 ms and nothing is sent or
        received meanwhile. set_time: see `admit`.
        """
        try:
            self._checked = self._check(
                layers, ledger, now, set_time=set_time, valid_for=_CHECKED_FOR
            )
        except CommandRefused as error:
            return error
        return None

    def _check(
        self,
        layers: Sequence[AmplifierLayer],
        ledger: Ledger,
        now: float,
        *,
        set_time: float,
        valid_for: float = 0.0,
    ) -> _CheckedSet:
        """Check layers for staging within a time from now [s]; raises CommandRefused."""
        delay = max(COMMIT_DELAY, ATTEMPTS * set_time)
        words = _word_count(layers)
        if words > PART_WORDS:  # parts for all amplifiers of the line, each perhaps repeated
            delay += 2 * words / PART_WORDS * set_time
        admitted = ledger.admit(layers, now, delay=delay + valid_for)
        stream = pack_layers(admitted)
        if not self._identification.is_complete and is_vibrating(*admitted):
            raise CommandRefused(f"amplifier {self._name} must be identified first; open it again")
        max_words = min(ledger.capabilities["set_words"], MAX_PARTS * PART_WORDS)
        if len(stream) > max_words:
            raise CommandRefused(f"a set must have at most {max_words} words, got {len(stream)}")
        return _CheckedSet(layers, admitted, stream, delay, now + valid_for)

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

    def expire_check(self) -> None:
        """Let the last check not be used again, because something was sent or received."""
        self._checked = None

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
