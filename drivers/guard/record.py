"""Playback of an amplifier as known to the host: confirmed sets, and those that were only sent.

A set that was sent and not confirmed may or may not play since then; the next set must be allowed
in either case. `Amplifier` records what it sends and what replies confirm.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.budget import COMMIT_DELAY, Budget, Vibration
from drivers.command import CommandSet, DriveCommand, Envelope
from drivers.errors import CommandRefused
from drivers.guard.channel_state import (
    ChannelState,
    Interval,
    duration,
    state_after,
    union_of,
)
from drivers.guard.rounding import TOLERANCE
from drivers.guard.voices import Voices, latest_of
from drivers.protocol.messages import Achieved, AmplifierState, Capabilities, Status
from registry.limits import GuardLimits

_ARRIVAL = 0.03  # s; in which a request arrives that has no reply, as the host's timeout
_SILENT = ChannelState()
_NO_FREQUENCY = _SILENT.frequency

_NO_ENVELOPE: tuple[None] = (None,)

States = tuple[ChannelState, ...]


@dataclass
class _Sent:
    """A set that may play; sent_at [s]: when it was sent.

    latest [s]: when it has been carried out if it ever is; infinite while a request for it is
    pending, None while it is only staged. before: the vibration as it was, of a set that vibrates.
    """

    command_set: CommandSet
    sent_at: float
    before: Vibration | None = None
    latest: float | None = math.inf
    achieved: tuple[DriveCommand, ...] = field(default=())


class PlayRecord:
    """The record of an amplifier with these capabilities in force, at first silent; clock [s].

    has_cross_fades: see `Capabilities`; slots: the envelopes that each slot may hold; last_token:
    of the set that was sent last.
    """

    def __init__(
        self, limits: GuardLimits, capabilities: Capabilities, clock: Callable[[], float]
    ) -> None:
        self.slots: dict[int, tuple[Envelope, ...]] = {}
        self.last_token = 0
        channels = capabilities.channels
        self._limits = limits
        self._max_voices = capabilities.voices
        self._has_cross_fades = capabilities.has_cross_fades
        self._clock = clock
        self._budget = Budget(limits)
        self._confirmed: States = (_SILENT,) * channels
        self._voices: tuple[Voices, ...] = (Voices(),) * channels  # of the confirmed sets
        self._confirmed_token = 0
        self._pending: list[_Sent] = []
        self._staged: _Sent | None = None
        self._may_be_silent = False  # a stop was sent and not confirmed

    def check(self, command_set: CommandSet, *, ramp: float) -> float:
        """Return the longest valid_for [s] of a set sent now; CommandRefused if it must not play.

        ramp [s]: by which it ends. Changes nothing.
        """
        now = self._clock()
        max_valid_for = math.inf
        if vibrates(command_set):
            max_valid_for = self._budget.remaining(now, fade=self._fade(command_set, ramp))
        elif not skips_endings(command_set):
            endings = [state.ending_time for state in self._confirmed if state.ending is not None]
            if max(endings, default=0.0) > self._budget.fade_left(now):
                raise CommandRefused("on-time or duty limit reached; end along a ramp")
        self._check_transition(command_set, now)
        return max_valid_for

    def room_from(self, command_set: CommandSet) -> float:
        """Return the time [s] from which a set is no voice too many on any channel.

        Later while sets that were sent are unconfirmed. Minus infinity for a set that needs no
        room: silence, one that ends the others at once, or one that was sent before.
        """
        token = command_set.token
        if token == self._confirmed_token or command_set.ramp == 0 or self._is_pending(token):
            return -math.inf
        voices = self._voices
        if self._pending:
            voices = self._voices_after(self._pending, self._clock())
        room_from, max_voices = -math.inf, self._max_voices
        for command in command_set.commands:
            if command.level > 0 or command.onset:
                known = voices[command.channel]
                if len(known.voices) >= max_voices:
                    room_from = max(room_from, known.room_from(max_voices))
        return room_from

    def fade_left(self) -> float:
        """Return the longest time [s] in which a silent set sent now may fade."""
        return self._budget.fade_left(self._clock())

    def send(self, command_set: CommandSet) -> None:
        """Record a set that is about to be sent, again or for the first time.

        Raises CommandRefused if sets sent since its check forbid it.
        """
        self.last_token = token = command_set.token
        if token == self._confirmed_token or self._is_pending(token):
            return
        now, before = self._clock(), None
        if vibrates(command_set):
            fade = self._fade(command_set, command_set.ramp)
            left = self._budget.remaining(now, fade=fade, delay=COMMIT_DELAY)
            if left < (command_set.valid_for or math.inf) and left != math.inf:
                raise CommandRefused("set was checked too long ago; check it again")
            self._check_transition(command_set, now)
            before = self._budget.sent(now, lasts=(command_set.valid_for or math.inf) + fade)
        elif not skips_endings(command_set):
            self._check_transition(command_set, now)
        self._pending.append(_Sent(command_set, now, before))

    def stage(self, command_set: CommandSet) -> None:
        """Record a set that is about to be staged: from then on it may be committed."""
        is_new = command_set.token not in [sent.command_set.token for sent in self._pending]
        self.send(command_set)
        self._staged = next(
            (sent for sent in self._pending if sent.command_set.token == command_set.token), None
        )
        if is_new and self._staged is not None:
            self._staged.latest = None

    def commit(self, token: int) -> None:
        """Record that the staged set is about to be committed."""
        if self._staged is not None and self._staged.command_set.token == token:
            self.send(self._staged.command_set)
            self._staged.latest = math.inf

    def refuse(self, token: int) -> None:
        """Record that the amplifier has refused the set of this token, which never plays."""
        if self._staged is not None and self._staged.command_set.token == token:
            self._staged = None
        if self._pending and self._pending[-1].command_set.token == token:
            self._budget.restore(self._pending[-1].before)
        self._pending = [sent for sent in self._pending if sent.command_set.token != token]

    def refuse_commit(self, token: int) -> None:
        """Record that the amplifier has not committed the set of this token, which stays staged."""
        for sent in self._pending:
            if sent.command_set.token == token:
                sent.latest = None

    def confirm_staged(self, token: int) -> None:
        """Record that the set of this token is staged, in the place of any other."""
        self._pending = [
            sent
            for sent in self._pending
            if sent.latest is not None or sent.command_set.token == token
        ]

    def left(self, token: int) -> None:
        """Record that no request to play the set of this token is pending any more."""
        for sent in self._pending:
            if sent.command_set.token == token and sent.latest == math.inf:
                sent.latest = self._clock() + _ARRIVAL

    def achieve(self, achieved: Achieved) -> None:
        """Record what a sent set plays once it is committed."""
        for sent in self._pending:
            if sent.command_set.token == achieved.token:
                sent.achieved = achieved.commands

    def confirm(self, token: int) -> None:
        """Record that the set of this token plays, and none that was sent before it."""
        if not self._is_pending(token):
            return
        now = self._clock()
        number = [sent.command_set.token for sent in self._pending].index(token)
        sent = self._pending[number]
        when = Interval(sent.sent_at, now)
        before = self._states(self._pending[:number], when)
        played = _played(sent)
        self._voices = self._with(sent, self._voices_after(self._pending[:number], now), now)
        if not self._needs_states(sent.command_set):
            self._confirmed = _upper_bounds_after(before, played, when)
        else:
            self._confirmed = states_after(before, played, when, self.slots)[0]
        self._confirmed_token = token
        self._pending = self._pending[number + 1 :]
        self._may_be_silent = False
        if not self._pending:
            self._budget.confirm(sent.sent_at, now, end=self._silent_at(sent.command_set, now))

    def silence_sent(self) -> None:
        """Record that a stop, a disarm or an arm is about to be sent."""
        self._may_be_silent = True

    def silenced(self, ramp: float) -> None:
        """Record that all channels fall silent within a ramp [s] from now at the latest."""
        now = self._clock()
        when = Interval(now, now)
        commands = tuple(
            DriveCommand(channel, 0.0, 0.0, skip_ending=True)
            for channel in range(len(self._confirmed))
        )
        silence = CommandSet(0, commands, ramp=ramp, valid_for=0.0)
        self._confirmed = states_after(self._states(self._pending, when), silence, when, {})[0]
        silent = _Sent(silence, now)
        self._voices = self._with(silent, self._voices_after(self._pending, now), now)
        self._confirmed_token = 0
        self._pending.clear()
        self._staged = None
        self._may_be_silent = False
        self._budget.confirm(now, now, end=now + ramp)

    def report(self, status: Status) -> None:
        """Record a status: a set that plays, or silence that lasts until the next arming."""
        if status.state is AmplifierState.OPERATION_ENABLED:
            self.confirm(status.token)
        elif not any(status.levels):
            self.silenced(0.0)

    def expect_load(self, envelope: Envelope) -> None:
        """Record an envelope that a slot may hold from now on; none may be left in an empty one."""
        others = [one for one in self.slots.pop(envelope.slot, ()) if one != envelope]
        if envelope.knots:
            self.slots[envelope.slot] = (*others, envelope)

    def load(self, envelope: Envelope) -> None:
        """Record the envelope that a slot holds."""
        if envelope.knots:
            self.slots[envelope.slot] = (envelope,)

    def _is_pending(self, token: int) -> bool:
        """Whether the set of this token was sent and not confirmed."""
        return token in [sent.command_set.token for sent in self._pending]

    def _check_transition(self, command_set: CommandSet, now: float) -> None:
        if not self._needs_states(command_set):
            return  # along one ramp no level exceeds both the old and the new one
        try:
            self._check_from(self._states(self._pending, Interval(now, now)), command_set, now)
        except CommandRefused as refused:
            refused.until = self._allowed_from(command_set, now)
            raise

    def _allowed_from(self, command_set: CommandSet, now: float) -> float | None:
        """Return the time [s] from which a set is allowed, if only current fades forbid it."""
        if self._pending or self._may_be_silent:
            return None
        settled = max(state.commit.latest + state.settled_after for state in self._confirmed)
        if not now < settled < math.inf:
            return None
        try:
            self._check_from(self._confirmed, command_set, settled)
        except CommandRefused:
            return None
        return settled

    def _check_from(self, before: States, command_set: CommandSet, now: float) -> None:
        """Raise CommandRefused if a set must not play after these states."""
        when = Interval(now, now + COMMIT_DELAY)
        after, slopes = states_after(before, command_set, when, self.slots)
        limits = self._limits
        if not self._has_cross_fades:
            _check_alone(before, command_set, when)
        for channel, slope in enumerate(slopes):
            if slope > limits.slew * TOLERANCE:
                raise CommandRefused(
                    f"channel {channel}: level must rise by at most {limits.slew:g} per second, "
                    f"got {slope:g} per second; use a longer ramp",
                    channel=channel,
                )
        if not self._is_shaped(command_set):
            return
        levels = [state.max_level for state in after]
        for channel, level in enumerate(levels):
            if level > limits.level * TOLERANCE:
                raise CommandRefused(
                    f"channel {channel}: level must be at most {limits.level:g} while the previous "
                    f"tone fades, got {level:g}; use a ramp instead of an envelope",
                    channel=channel,
                )
        power = sum(level**2 for level in levels)
        if power > limits.power * TOLERANCE:
            raise CommandRefused(
                f"sum of squared levels must be at most {limits.power:g} while the previous tones "
                f"fade, got {power:g}; use a ramp instead of an envelope"
            )

    def _needs_states(self, command_set: CommandSet) -> bool:
        """Whether levels along a ramp, or frequencies that sound together, decide on a set."""
        return (
            self._limits.slew < math.inf
            or not self._has_cross_fades
            or self._is_shaped(command_set)
        )

    def _is_shaped(self, command_set: CommandSet) -> bool:
        """Whether a channel may follow an envelope during this set or at its end."""
        for command in command_set.commands:
            if command.onset or command.ending:
                return True
        for state in self._confirmed:
            if state.ending or state.is_shaped or state.fading_may_hold:
                return True
        return bool(self._pending) and any(
            command.ending for sent in self._pending for command in sent.command_set.commands
        )

    def _states(self, pending: Sequence[_Sent], when: Interval) -> States:
        """Return the states in which the channels may be once the sets before have been sent."""
        states = self._confirmed
        for sent in pending:
            committed = Interval(sent.sent_at, max(sent.sent_at, when.latest))
            after, _ = states_after(states, _played(sent), committed, self.slots)
            states = tuple(union_of(both, committed) for both in zip(states, after, strict=True))
        if self._may_be_silent:
            states = tuple(union_of((state, _SILENT), when) for state in states)
        return states

    def _voices_after(self, pending: Sequence[_Sent], now: float) -> tuple[Voices, ...]:
        """Return upper bounds of the voices once the sets before have been sent."""
        voices = self._voices
        for sent in pending:
            if sent.latest is not None:
                after = self._with(sent, voices, min(now, sent.latest))
                voices = tuple(map(latest_of, zip(voices, after, strict=True)))
        return voices

    def _with(self, sent: _Sent, voices: tuple[Voices, ...], latest: float) -> tuple[Voices, ...]:
        """Return the voices once a set plays, since a time [s] at the latest."""
        requested = sent.command_set
        commands = {command.channel: command for command in requested.commands}
        commit = Interval(min(sent.sent_at, latest), latest)
        following = []
        for channel, before in enumerate(voices):
            command = commands.get(channel) or DriveCommand(channel, 0.0, 0.0)
            following.append(
                before.after(
                    command,
                    commit,
                    ramp=requested.ramp,
                    valid_for=requested.valid_for,
                    onset=self._maximum(command.onset) if command.onset else 0.0,
                    ending=self._maximum(command.ending) if command.ending else 0.0,
                )
            )
        return tuple(following)

    def _maximum(self, slot: int) -> float:
        """Return the longest duration [s] of an envelope that a slot may hold."""
        return max(map(duration, self.slots.get(slot, ())), default=0.0)

    def _fade(self, command_set: CommandSet, ramp: float) -> float:
        """Return the longest time [s] from the end of a set until silence."""
        fade = ramp
        for command in command_set.commands:
            if command.ending:
                fade = max(fade, self._maximum(command.ending))
        return fade

    def _silent_at(self, command_set: CommandSet, now: float) -> float:
        """Return the latest time [s] at which a confirmed set is silent."""
        if vibrates(command_set):
            lasts = command_set.valid_for or math.inf
            return now + lasts + self._fade(command_set, command_set.ramp)
        return now + max(state.settled_after for state in self._confirmed)


def vibrates(command_set: CommandSet) -> bool:
    """Whether a set drives any channel, if only by an onset."""
    return any(command.level > 0 or command.onset for command in command_set.commands)


def skips_endings(command_set: CommandSet) -> bool:
    """Whether a silent set skips earlier endings on all channels."""
    return all(command.skip_ending for command in command_set.commands)


def _check_alone(before: States, command_set: CommandSet, when: Interval) -> None:
    """Raise CommandRefused if a channel would go over to a tone that does not continue."""
    for command in command_set.commands:
        continued = {command.frequency} if command.keep_phase else set()
        others = before[command.channel].frequencies_at(when) - continued - {_NO_FREQUENCY}
        if command.level > 0 and others:
            raise CommandRefused(
                f"channel {command.channel} must be silent before {command.frequency:g} Hz, since "
                "its amplifier cannot cross-fade, got one that plays "
                f"{', '.join(f'{one:g}' for one in sorted(others))} Hz; play silence first",
                channel=command.channel,
            )


def states_after(
    states: States,
    command_set: CommandSet,
    when: Interval,
    slots: dict[int, tuple[Envelope, ...]],
) -> tuple[States, list[float]]:
    """Return the states after a set, and the steepest rise [1/s] of each channel."""
    commands = {command.channel: command for command in command_set.commands}
    ramp, valid_for = command_set.ramp, command_set.valid_for
    following, slopes = [], []
    for channel, state in enumerate(states):
        command = commands.get(channel) or DriveCommand(channel, 0.0, 0.0)
        # A slot may hold one of several envelopes while one is being loaded.
        several = [
            state_after(
                state, command, when, ramp=ramp, valid_for=valid_for, onset=onset, ending=ending
            )
            for onset in slots.get(command.onset) or _NO_ENVELOPE
            for ending in slots.get(command.ending) or _NO_ENVELOPE
        ]
        if len(several) == 1:
            ((after, slope),) = several
        else:
            after = union_of([one for one, _ in several], when)
            slope = max(slope for _, slope in several)
        following.append(after)
        slopes.append(slope)
    return tuple(following), slopes


def _upper_bounds_after(states: States, command_set: CommandSet, when: Interval) -> States:
    """Return states after a set of ramps, with upper bounds of its levels only."""
    tones = {command.channel: command for command in command_set.commands}
    ramp, valid_for = command_set.ramp, command_set.valid_for or math.inf
    bounds = []
    for channel, state in enumerate(states):
        tone = tones.get(channel)
        bounds.append(
            ChannelState(
                frequency=tone.frequency if tone else 0.0,
                path=(0j, complex(tone.level if tone else 0.0)),
                step=ramp,
                commit=when,
                fading=state.high(when),
                fade=ramp,
                valid_for=valid_for,
            )
        )
    return tuple(bounds)


def _played(sent: _Sent) -> CommandSet:
    """Return what a sent set plays, with the levels that the amplifier reported."""
    requested = sent.command_set
    if not sent.achieved:
        return requested
    return CommandSet(
        requested.token, sent.achieved, ramp=requested.ramp, valid_for=requested.valid_for
    )
