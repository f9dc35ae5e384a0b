"""What goes to the amplifiers of a rig: routed, shaped where they can, let through by guards."""

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

from controller.loop.envelopes import wire_envelopes
from controller.loop.routing import goes_on, route, route_again, route_end
from drivers.command import DriveCommand
from drivers.errors import CommandRefused
from drivers.guard import Guard, SafeCommandSet, SafeEnvelope
from drivers.protocol.definition import token_after
from model.rig.rig import Rig
from model.table.pattern import Pattern
from model.table.question import Question

FADE_RAMP = 0.020
"""How fingers that stay on the plate are left [s]; a shorter end they would feel as a tap."""

_logger = logging.getLogger(__name__)


class PatternTiming(Protocol):
    """What is needed of `model.table.timing.Timing`."""

    def prepare(self, frequencies: Iterable[float]) -> None:
        """Work out ahead what shaping needs to know about frequencies [Hz]."""

    def with_envelopes(
        self, question: Question, pattern: Pattern, *, onset: bool, ending: bool
    ) -> Pattern:
        """The pattern with a shaped onset, ending, or both."""

    def with_transient_measures(self, question: Question, pattern: Pattern) -> Pattern:
        """The pattern with its contrast over the first 100 ms, from rest."""


@dataclass(frozen=True)
class Order:
    """A command set for every amplifier, by its name, and the envelopes to be loaded before it.

    pattern: what is played by it, with the ramp and the onset that really are, or None; is_brake:
    whether it only gives endings to what plays already. problem: why a guard refused a pattern, so
    that it is silence instead; again_at: when [s] that pattern may be asked for again, None for
    never.
    """

    commands: Mapping[str, SafeCommandSet]
    envelopes: Mapping[str, tuple[SafeEnvelope, ...]] = field(default_factory=dict)
    pattern: Pattern | None = None
    is_brake: bool = False
    problem: str | None = None
    again_at: float | None = None

    @property
    def is_silence(self) -> bool:
        """Whether all channels fall silent along the ramp, with no ending of their own."""
        return all(
            command.level == 0 and not command.onset and command.skip_ending
            for safe in self.commands.values()
            for command in safe.commands
        )

    @property
    def settled_after(self) -> float:
        """How long [s] after its commit at the latest nothing fades any more."""
        return max((safe.settled_after for safe in self.commands.values()), default=0.0)


class OrderMaker:
    """Makes the orders of one rig; guards by the names of its amplifiers, one for each.

    timing: what shapes patterns; None for ramps only.
    """

    def __init__(
        self, rig: Rig, guards: Mapping[str, Guard], *, timing: PatternTiming | None
    ) -> None:
        self._rig = rig
        self._guards = guards
        self._timing = timing
        self._token = 0

    def play(
        self,
        pattern: Pattern,
        question: Question,
        *,
        is_shaped: bool,
        playing: Mapping[str, DriveCommand],
    ) -> Order:
        """The order of a pattern, or silence everywhere if a guard refuses any of it.

        is_shaped: whether to find onsets for it; where a guard refuses these, ramps take their
        place. playing: what ERAs play now; what runs on needs no onset.
        """
        if is_shaped and self._timing is not None and not goes_on(pattern.excitation, playing):
            shaped = self._timing.with_envelopes(question, pattern, onset=True, ending=False)
            try:
                return self._shaped(shaped, playing)
            except CommandRefused as problem:
                _logger.info("a plain ramp takes the place of envelopes: %s", problem)
        sets = route(
            pattern.excitation,
            self._rig,
            token=self._next_token(),
            ramp=pattern.ramp,
            playing=playing,
        )
        checked = {
            name: guard.check_or_silence(sets[name], ramp=FADE_RAMP)
            for name, guard in self._guards.items()
        }
        refusals = {name: refusal for name, (_, refusal) in checked.items() if refusal}
        if refusals:
            return self._refused(refusals)
        commands = {name: safe for name, (safe, _) in checked.items()}
        return Order(commands, pattern=_as_played(pattern, commands))

    def brake(
        self, pattern: Pattern, question: Question, *, playing: Mapping[str, DriveCommand]
    ) -> Order | None:
        """The order that gives what plays an ending; None if a guard refuses any of it."""
        if self._timing is None:
            return None
        braked = self._timing.with_envelopes(
            question, replace(pattern, onset=None), onset=False, ending=True
        )
        if braked.ending is None:
            return None
        try:
            envelopes = self._envelopes(braked)
            sets = route_again(
                playing,
                self._rig,
                token=self._next_token(),
                ramp=FADE_RAMP,
                ending=braked.ending,
            )
            commands = {name: guard.check(sets[name]) for name, guard in self._guards.items()}
        except CommandRefused as problem:
            _logger.info("a plain ramp takes the place of a brake: %s", problem)
            return None
        return Order(commands, envelopes, braked, is_brake=True)

    def end(self) -> Order:
        """The order by which every ERA ends along the brake that it was given, or silence."""
        sets = route_end(self._rig, token=self._next_token(), ramp=FADE_RAMP)
        try:
            return Order({name: guard.check(sets[name]) for name, guard in self._guards.items()})
        except Exception as problem:  # silence is right for every kind of failure
            _logger.warning("all fall silent along a ramp, for the brake was refused: %s", problem)
            return self.silence(ramp=FADE_RAMP)

    def silence(self, *, ramp: float) -> Order:
        """The order that brings every wired channel to zero along a ramp [s]; never fails."""
        token = self._next_token()
        return Order(
            {
                name: guard.silence(
                    token,
                    [each.number for each in self._rig.wiring.values() if each.amplifier == name],
                    ramp=ramp,
                )
                for name, guard in self._guards.items()
            }
        )

    def _refused(self, refusals: Mapping[str, CommandRefused]) -> Order:
        """Silence, and why, by amplifier; where all that is wrong passes by itself, until when."""
        moments = [refusal.until for refusal in refusals.values()]
        known = [moment for moment in moments if moment is not None]
        return replace(
            self.silence(ramp=FADE_RAMP),
            problem="; ".join(f"{name}: {refusal}" for name, refusal in refusals.items()),
            again_at=max(known) if len(known) == len(moments) else None,
        )

    def _shaped(self, pattern: Pattern, playing: Mapping[str, DriveCommand]) -> Order:
        """The order of a pattern with its envelopes; raises CommandRefused."""
        envelopes = self._envelopes(pattern)
        sets = route(
            pattern.excitation,
            self._rig,
            token=self._next_token(),
            ramp=pattern.ramp,
            playing=playing,
            onset=pattern.onset,
        )
        commands = {name: guard.check(sets[name]) for name, guard in self._guards.items()}
        return Order(commands, envelopes, _as_played(pattern, commands))

    def _envelopes(self, pattern: Pattern) -> dict[str, tuple[SafeEnvelope, ...]]:
        """The envelopes of a pattern, by amplifier; raises CommandRefused."""
        loads = wire_envelopes(pattern, self._rig)
        return {
            name: tuple(guard.check_envelope(each) for each in loads[name])
            for name, guard in self._guards.items()
        }

    def _next_token(self) -> int:
        """A token that all amplifiers share: 1..65535, then from 1 again."""
        self._token = token_after(self._token)
        return self._token


def _as_played(pattern: Pattern, commands: Mapping[str, SafeCommandSet]) -> Pattern:
    """The pattern with the ramp that its sets have, which a limit of slew may have lengthened."""
    ramp = max(safe.ramp for safe in commands.values())
    return pattern if ramp == pattern.ramp else replace(pattern, ramp=ramp)
