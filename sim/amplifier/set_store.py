"""Sets and envelopes of a simulated amplifier: checked, rounded to steps, and stored."""

import math
from dataclasses import replace

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandError
from drivers.protocol.definition import PROTOCOL, WireQuantity, is_newer_token
from drivers.protocol.messages import (
    Achieved,
    Capabilities,
    ChannelLimits,
    Feature,
    Loaded,
    Nak,
    NakCode,
)
from sim.amplifier.channels import PlayableSet

_Q = PROTOCOL.quantities
_ANY_PHASE = 137.0  # degrees from channel to channel, of an amplifier without phases


class RefusedSet(Exception):
    """A set or an envelope that is refused with a Nak."""

    def __init__(self, code: NakCode, channel: int | None = None) -> None:
        super().__init__(code.name)
        self.nak = Nak(code, channel)


class SetStore:
    """The staged and the active set, and loaded envelopes by slot; RefusedSet changes nothing."""

    def __init__(self, capabilities: Capabilities) -> None:
        self._capabilities = capabilities
        self.slots: dict[int, Envelope] = {}
        self.staged: PlayableSet | None = None
        self.active: PlayableSet | None = None
        self._staged_at = -math.inf

    @property
    def token(self) -> int:
        """Token of the active set, 0 for none."""
        return self.active.token if self.active else 0

    def is_repeated(self, wanted: CommandSet) -> bool:
        """Whether this is the active set again; refused if only its token is."""
        if self.active is None or wanted.token != self.token:
            return False
        if wanted != self.active.asked:
            raise RefusedSet(NakCode.BAD_TOKEN)
        return True

    def load(self, envelope: Envelope) -> Loaded:
        """Store an envelope in its slot; one without knots clears it."""
        kept = _quantised_envelope(envelope, self._capabilities)
        if kept.knots:
            self.slots[kept.slot] = kept
        else:
            self.slots.pop(kept.slot, None)
        return Loaded(slot=kept.slot, knots=len(kept.knots))

    def prepare(self, wanted: CommandSet, *, derating_factor: float) -> PlayableSet:
        """Check a set, with the present envelopes, its levels times the factor."""
        if not is_newer_token(wanted.token, self.token):  # a late copy
            raise RefusedSet(NakCode.BAD_TOKEN)
        playable = self._with_envelopes(wanted)
        return playable if derating_factor == 1 else playable.derated(derating_factor)

    def stage(self, playable: PlayableSet, now: float) -> Achieved:
        """Stage a set at a time [s]."""
        self.staged, self._staged_at = playable, now
        return playable.achieved

    def staged_as(self, token: int, now: float) -> PlayableSet:
        """The set that is staged under a token at a time [s]."""
        is_old = now - self._staged_at > PROTOCOL.staged_life
        if is_old or self.staged is None or self.staged.token != token:
            raise RefusedSet(NakCode.BAD_TOKEN)
        return self.staged

    def activate(self, playable: PlayableSet) -> None:
        """Make a set the active one."""
        self.active, self.staged = playable, None

    def forget(self) -> None:
        """Discard the sets; envelopes stay."""
        self.staged = self.active = None

    def _with_envelopes(self, wanted: CommandSet) -> PlayableSet:
        quantised = _quantised_set(wanted, self._capabilities)
        onsets: dict[int, Envelope] = {}
        endings: dict[int, Envelope] = {}
        for command in quantised.commands:
            if not (command.onset or command.ending):
                continue
            for slot, shapes in ((command.onset, onsets), (command.ending, endings)):
                if slot and slot not in self.slots:
                    raise RefusedSet(NakCode.NO_ENVELOPE, command.channel)
                if slot:
                    shapes[command.channel] = self._within(command.channel, self.slots[slot])
        return PlayableSet(quantised, wanted, onsets, endings)

    def _within(self, channel: int, envelope: Envelope) -> Envelope:
        """The envelope, whose knots must not exceed the channel's own level."""
        highest = self._capabilities.limits_of_channels[channel].level_max
        if any(knot.level > highest for knot in envelope.knots):
            raise RefusedSet(NakCode.BAD_VALUE, channel)
        return envelope


def _quantised_set(wanted: CommandSet, capabilities: Capabilities) -> CommandSet:
    """The set as it will be played; raises RefusedSet.

    The frequency of a silent channel may be out of range.
    """
    if not _Q.token.holds(wanted.token):
        raise RefusedSet(NakCode.BAD_TOKEN)
    if wanted.valid_for and Feature.VALID_FOR not in capabilities.features:
        raise RefusedSet(NakCode.BAD_VALUE)
    channels = [command.channel for command in wanted.commands]
    for channel in channels:
        if not 0 <= channel < capabilities.channels or channels.count(channel) > 1:
            raise RefusedSet(NakCode.BAD_CHANNEL, channel)
    limits = capabilities.limits_of_channels
    has_phase = Feature.PHASE in capabilities.features
    return CommandSet(
        token=wanted.token,
        commands=tuple(
            _quantised(command, limits[command.channel], has_phase=has_phase)
            for command in wanted.commands
        ),
        ramp=_in_steps(_Q.ramp, wanted.ramp),
        valid_for=_in_steps(_Q.valid_for, wanted.valid_for),
    )


def _quantised_envelope(wanted: Envelope, capabilities: Capabilities) -> Envelope:
    """The envelope as it will be stored; raises RefusedSet."""
    low, high = capabilities.envelope_step_min, capabilities.envelope_step_max
    step = _in_steps(_Q.envelope_step, wanted.step)
    if (
        not 1 <= wanted.slot <= capabilities.envelope_slots
        or not low <= step <= high
        or len(wanted.knots) > capabilities.envelope_knots
    ):
        raise RefusedSet(NakCode.BAD_VALUE)
    knots = tuple(
        Knot(_in_steps(_Q.level, knot.level), _in_steps(_Q.phase, knot.phase))
        for knot in wanted.knots
    )
    return Envelope(wanted.slot, step, knots)


def _quantised(command: DriveCommand, limits: ChannelLimits, *, has_phase: bool) -> DriveCommand:
    phase = command.phase if has_phase else _ANY_PHASE * command.channel
    try:
        frequency = _Q.frequency.quantise(command.frequency)
        level = _Q.level.quantise(command.level)
        phase = _Q.phase.quantise(phase)
    except CommandError as error:
        raise RefusedSet(NakCode.BAD_VALUE, command.channel) from error
    is_playable = limits.frequency_min <= frequency <= limits.frequency_max
    if level > limits.level_max or (level > 0 and not is_playable):
        raise RefusedSet(NakCode.BAD_VALUE, command.channel)
    if (frequency, level, phase) == (command.frequency, command.level, command.phase):
        return command
    return replace(command, frequency=frequency, level=level, phase=phase)


def _in_steps(quantity: WireQuantity, value: float) -> float:
    try:
        return quantity.quantise(value)
    except CommandError as error:
        raise RefusedSet(NakCode.BAD_VALUE) from error
