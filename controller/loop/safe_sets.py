"""Command sets for all amplifiers of a rig: routed, shaped where possible, checked by guards."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from controller.loop.envelopes import wire_envelopes
from controller.loop.routing import continues_any_tone, route, route_to_silence, route_with_endings
from drivers import clock
from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import Guard, SafeCommandSet, SafeEnvelope
from drivers.protocol.definition import random_token, token_after
from model.rig.rig import Rig
from model.table.pattern import Pattern
from model.table.question import Question
from model.table.timing import Timing

FADE_RAMP = 0.020
"""Fade-out [s] under fingers that stay on the plate; a shorter one would feel like a tap."""

_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SafeSets:
    """A checked command set for every amplifier, by name, and envelopes to load before them.

    plain: the same pattern along its ramp, where loading takes too long; None without any. ready_at
    [s]: when it could have been sent without envelopes; shaping and loading delay it from then on.
    """

    sets: Mapping[str, SafeCommandSet]
    envelopes: Mapping[str, tuple[SafeEnvelope, ...]] = field(default_factory=dict)
    plain: "SafeSets | None" = None
    ready_at: float = -math.inf

    @property
    def token(self) -> int:
        """The token, which all its sets have."""
        return next(iter(self.sets.values())).token

    @property
    def is_silence(self) -> bool:
        """Whether all channels fall silent along the ramp, without endings."""
        return all(
            command.level == 0 and not command.onset and command.skip_ending
            for safe in self.sets.values()
            for command in safe.commands
        )

    @property
    def valid_for(self) -> float:
        """Time [s] after the commit when the first amplifier ends its vibration by itself."""
        times = [safe.valid_for for safe in self.sets.values() if not safe.is_silent]
        return min((time for time in times if time > 0), default=math.inf)

    @property
    def room_from(self) -> float:
        """When [s] every channel that they drive has a voice for them; see `PlayRecord`."""
        return max([safe.record.room_from(safe) for safe in self.sets.values()])

    @property
    def settled_after(self) -> float:
        """Time [s] after the commit when the last fade or envelope has ended."""
        return max((safe.settled_after for safe in self.sets.values()), default=0.0)


class SetBuilder:
    """Builds the safe sets of one rig; guards by amplifier name, one for each.

    timing: shapes patterns; None for ramps only.
    """

    def __init__(self, rig: Rig, guards: Mapping[str, Guard], *, timing: Timing | None) -> None:
        self._rig = rig
        self._guards = guards
        self._timing = timing
        self._ramp_max = min((guard.ramp_max for guard in guards.values()), default=math.inf)
        self._fade_ramp = min(FADE_RAMP, self._ramp_max)
        self._token = random_token()

    def replace(self, timing: Timing | None) -> None:
        """Shape by another timing from now on."""
        self._timing = timing

    def build_pattern(
        self,
        pattern: Pattern,
        question: Question,
        *,
        is_shaped: bool,
        playing: Mapping[str, DriveCommand],
        valid_for: float,
    ) -> tuple[SafeSets, Pattern]:
        """Build the sets of a pattern; returns them and the pattern with the ramp they have.

        is_shaped: whether to shape its onset; a ramp takes its place where a guard refuses it.
        playing: what each ERA plays now; a tone that continues needs no onset. valid_for [s]: for
        how long it plays unless it is renewed. Raises CommandRefused if a guard refuses any of it.
        """
        plain, ramped = self._build_plain(pattern, playing=playing, valid_for=valid_for)
        ready_at = clock.now()
        if (
            is_shaped
            and self._timing is not None
            and not continues_any_tone(pattern.excitation, playing)
        ):
            shaped = self._timing.with_envelopes(question, pattern, onset=True, ending=False)
            try:
                envelopes = self._envelopes(shaped)
                sets = self._checked(self._routed(shaped, playing, valid_for))
                return SafeSets(sets, envelopes, plain, ready_at), _with_ramp(shaped, sets)
            except CommandRefused as error:
                _logger.info("loop: plain ramp instead of an onset: %s", error)
        return plain, ramped

    def _build_plain(
        self, pattern: Pattern, *, playing: Mapping[str, DriveCommand], valid_for: float
    ) -> tuple[SafeSets, Pattern]:
        """Build the sets of a pattern along its ramp; raises CommandRefused."""
        plain = pattern if pattern.onset is None else replace(pattern, onset=None)
        routed = self._routed(plain, playing, valid_for)
        # Every guard sees its set, so that all refusals are reported at once.
        checked = {
            name: guard.check_or_silence(routed[name], ramp=FADE_RAMP)
            for name, guard in self._guards.items()
        }
        refusals = {name: refusal for name, (_, refusal) in checked.items() if refusal}
        if refusals:
            raise _merged(refusals)
        sets = {name: safe for name, (safe, _) in checked.items()}
        return SafeSets(sets), _with_ramp(pattern, sets)

    def build_endings(
        self,
        pattern: Pattern,
        question: Question,
        *,
        playing: Mapping[str, DriveCommand],
        valid_for: float,
    ) -> SafeSets | None:
        """Build the sets that add shaped endings to the playback; None if a guard refuses any."""
        if self._timing is None:
            return None
        shaped = self._timing.with_envelopes(
            question, replace(pattern, onset=None), onset=False, ending=True
        )
        if shaped.ending is None:
            return None
        try:
            envelopes = self._envelopes(shaped)
            sets = route_with_endings(
                playing,
                self._rig,
                token=self._next_token(),
                ramp=self._fade_ramp,
                ending=shaped.ending,
            )
            checked = self._checked(_with_valid_for(sets, valid_for))
            return SafeSets(checked, envelopes, ready_at=clock.now())
        except CommandRefused as error:
            _logger.info("loop: plain ramp instead of an ending: %s", error)
            return None

    def build_renewal(self, played: SafeSets, *, valid_for: float) -> SafeSets | None:
        """Build the sets that prolong played ones for a time [s]; None if a guard refuses one."""
        token = self._next_token()
        sets = {
            name: CommandSet(
                token=token,
                commands=tuple(
                    replace(command, keep_phase=command.level > 0, onset=0)
                    for command in safe.commands
                ),
                ramp=self._fade_ramp,
                valid_for=valid_for,
            )
            for name, safe in played.sets.items()
        }
        try:
            return SafeSets(self._checked(sets))
        except CommandRefused as error:
            _logger.debug("loop: vibration not renewed: %s", error)
            return None

    def build_end(self) -> SafeSets:
        """Build the sets that end every ERA along its ending; plain silence if refused."""
        sets = route_to_silence(self._rig, token=self._next_token(), ramp=self._fade_ramp)
        try:
            return SafeSets(self._checked(sets))
        except Exception as error:  # silence is right for every kind of failure
            _logger.warning("loop: silencing along a ramp, endings refused: %s", error)
            return self.build_silence(ramp=FADE_RAMP)

    def build_silence(self, *, ramp: float, before: SafeSets | None = None) -> SafeSets:
        """Build the sets that ramp [s] every wired channel to zero; never fails.

        before: sets that are played later but were built already.
        """
        if before is not None:
            before = before.plain or before  # which was built first, and may take its place
        token = self._next_token() if before is None else before.token - 1
        return SafeSets(
            {
                name: guard.silence(
                    token,
                    [each.number for each in self._rig.wiring.values() if each.amplifier == name],
                    ramp=ramp,
                )
                for name, guard in self._guards.items()
            }
        )

    def _routed(
        self, pattern: Pattern, playing: Mapping[str, DriveCommand], valid_for: float
    ) -> dict[str, CommandSet]:
        """Route a pattern to the rig's channels under the next token."""
        return route(
            pattern.excitation,
            self._rig,
            token=self._next_token(),
            ramp=min(pattern.ramp, self._ramp_max),
            playing=playing,
            onset=pattern.onset,
            valid_for=valid_for,
        )

    def _checked(self, sets: Mapping[str, CommandSet]) -> dict[str, SafeCommandSet]:
        """Check every set by its guard; raises CommandRefused."""
        return {name: guard.check(sets[name]) for name, guard in self._guards.items()}

    def _envelopes(self, pattern: Pattern) -> dict[str, tuple[SafeEnvelope, ...]]:
        """Check the envelopes of a pattern, by amplifier; raises CommandRefused."""
        loads = wire_envelopes(pattern, self._rig)
        return {
            name: tuple(guard.check_envelope(each) for each in loads[name])
            for name, guard in self._guards.items()
        }

    def _next_token(self) -> int:
        """Return a token for all amplifiers; the one before it is free for a silence."""
        self._token = token_after(token_after(self._token))
        if self._token == 1:
            self._token = 2
        return self._token


def _with_valid_for(sets: Mapping[str, CommandSet], valid_for: float) -> dict[str, CommandSet]:
    """Return sets with this valid_for [s]."""
    return {name: replace(each, valid_for=valid_for) for name, each in sets.items()}


def _merged(refusals: Mapping[str, CommandRefused]) -> CommandRefused:
    """Join refusals by amplifier; `until` is known only if all of them pass by themselves."""
    moments = [refusal.until for refusal in refusals.values()]
    known = [moment for moment in moments if moment is not None]
    return CommandRefused(
        "; ".join(f"{name}: {refusal}" for name, refusal in refusals.items()),
        until=max(known) if len(known) == len(moments) else None,
    )


def _with_ramp(pattern: Pattern, sets: Mapping[str, SafeCommandSet]) -> Pattern:
    """Return the pattern with the ramp of its sets, which a slew limit may have lengthened."""
    ramp = max(safe.ramp for safe in sets.values())
    return pattern if ramp == pattern.ramp else replace(pattern, ramp=ramp)
