"""Sets and envelopes stored in a simulated amplifier."""

from collections import deque

from drivers.command import CommandSet, Envelope
from drivers.protocol.messages import Achieved, Capabilities, Loaded, NakCode
from sim.amplifier.channels import PlayableSet
from sim.amplifier.quantiser import RefusedSet, quantise_envelope, quantise_set

_TOKENS_REMEMBERED = 16  # late duplicates are older than a few exchanges at most


class SetStore:
    """The staged and the active set, and loaded envelopes by slot; RefusedSet changes nothing."""

    def __init__(self, capabilities: Capabilities) -> None:
        self._capabilities = capabilities
        self.slots: dict[int, Envelope] = {}
        self.staged: PlayableSet | None = None
        self.active: PlayableSet | None = None
        self.tokens: deque[int] = deque(maxlen=_TOKENS_REMEMBERED)

    @property
    def token(self) -> int:
        """Token of the active set, 0 for none."""
        return self.active.token if self.active else 0

    def playing(self, token: int) -> PlayableSet | None:
        """The active set if this is its token."""
        return self.active if self.active and self.active.token == token else None

    def load(self, envelope: Envelope) -> Loaded:
        """Store an envelope in its slot; one without knots clears it."""
        kept = quantise_envelope(envelope, self._capabilities)
        if kept.knots:
            self.slots[kept.slot] = kept
        else:
            self.slots.pop(kept.slot, None)
        return Loaded(slot=kept.slot, knots=len(kept.knots))

    def stage(self, wanted: CommandSet, *, share: float) -> Achieved:
        """Stage a set with the present envelopes, at a share of its levels."""
        if wanted.token in self.tokens:  # a late duplicate
            raise RefusedSet(NakCode.BAD_TOKEN)
        staged = self._with_envelopes(quantise_set(wanted, self._capabilities))
        self.staged = staged if share == 1 else staged.derated(share)
        return self.staged.achieved

    def commit(self, token: int) -> PlayableSet:
        """Make the staged set active."""
        if self.staged is None or self.staged.token != token:
            raise RefusedSet(NakCode.BAD_TOKEN)
        self.active, self.staged = self.staged, None
        self.tokens.append(token)
        return self.active

    def forget(self) -> None:
        """Discard the sets; envelopes stay."""
        self.staged = self.active = None
        self.tokens.clear()

    def _with_envelopes(self, wanted: CommandSet) -> PlayableSet:
        onsets: dict[int, Envelope] = {}
        endings: dict[int, Envelope] = {}
        for command in wanted.commands:
            for slot, shapes in ((command.onset, onsets), (command.ending, endings)):
                if slot and slot not in self.slots:
                    raise RefusedSet(NakCode.NO_ENVELOPE, command.channel)
                if slot:
                    shapes[command.channel] = self.slots[slot]
        return PlayableSet(wanted, onsets, endings)
