"""The guard: the only maker of commands that an encoder will take.

Its limits are the least of the configuration, what the amplifier reports and built-in ceilings;
nothing sets them at run time.
"""

from collections.abc import Callable, Collection
from typing import final

from drivers.clock import now
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandRefused
from drivers.guard.budget import Budget
from drivers.guard.limits import GuardLimits, tightest
from drivers.guard.rules import Known, check_envelope, check_set, is_number, is_token
from drivers.protocol.definition import PROTOCOL, token_after
from drivers.protocol.messages import Capabilities

_KEY = object()


@final
class SafeCommandSet(CommandSet):
    """A command set that a guard has let through; only a `Guard` can make one.

    settled_after [s]: how long after its commit at the latest nothing fades any more.
    """

    settled_after: float

    def __init__(
        self,
        token: int,
        commands: tuple[DriveCommand, ...],
        *,
        ramp: float,
        valid_for: float,
        settled_after: float = 0.0,
        key: object = None,
    ) -> None:
        if key is not _KEY:
            raise TypeError(
                "a SafeCommandSet is made by Guard.check or Guard.silence, by nobody else"
            )
        super().__init__(token=token, commands=commands, ramp=ramp, valid_for=valid_for)
        object.__setattr__(self, "settled_after", settled_after)

    def __init_subclass__(cls) -> None:
        raise TypeError("SafeCommandSet cannot be subclassed")


@final
class SafeEnvelope(Envelope):
    """An envelope that a guard has let through; only a `Guard` can make one."""

    def __init__(
        self, slot: int, step: float, knots: tuple[Knot, ...], *, key: object = None
    ) -> None:
        if key is not _KEY:
            raise TypeError("a SafeEnvelope is made by Guard.check_envelope, by nobody else")
        super().__init__(slot=slot, step=step, knots=knots)

    def __init_subclass__(cls) -> None:
        raise TypeError("SafeEnvelope cannot be subclassed")


@final
class Guard:
    """Lets the command sets of one amplifier through or refuses them.

    clock [s]: by which rate, on-time and duty are counted, the event loop's unless given. Raises
    CommandError for limits that leave nothing to play.
    """

    def __init__(
        self,
        limits: GuardLimits,
        capabilities: Capabilities,
        *,
        clock: Callable[[], float] = now,
    ) -> None:
        self._bounds = tightest(limits, capabilities)
        self._clock = clock
        self._budget = Budget(self._bounds)
        self._last_token = 0
        self._playing: dict[int, DriveCommand] = {}
        self._loaded: dict[int, SafeEnvelope] = {}

    @property
    def limits(self) -> GuardLimits:
        """The limits in force: the least of configuration, amplifier and ceilings."""
        bounds = self._bounds
        return GuardLimits(
            frequency_min=bounds.frequency_min,
            frequency_max=bounds.frequency_max,
            level=bounds.level,
            slew=bounds.slew,
            power=bounds.power,
            on_time=bounds.on_time,
            duty=bounds.duty,
            rate=bounds.rate,
        )

    def check(self, command_set: CommandSet) -> SafeCommandSet:
        """The set as a command that may be sent; CommandRefused says which channel and why.

        Where on-time or duty are limited, valid_for is made short enough for them.
        """
        check_set(command_set, self._bounds, Known(self._playing, self._loaded))
        valid_for = float(command_set.valid_for)
        shaped = any(command.onset for command in command_set.commands)
        if shaped or not command_set.is_silent:
            remaining = self._budget.remaining(self._clock())
            if remaining is not None:
                valid_for = min(valid_for or remaining, remaining, _LONGEST)
        # A silent channel keeps no frequency that an amplifier could stumble over.
        commands = tuple(
            DriveCommand(
                channel=int(command.channel),
                frequency=float(
                    command.frequency
                    if command.level > 0 or command.onset
                    else self._idle_frequency
                ),
                level=float(command.level),
                phase=float(command.phase),
                keep_phase=bool(command.keep_phase),
                onset=int(command.onset),
                ending=int(command.ending),
                skip_ending=bool(command.skip_ending),
            )
            for command in command_set.commands
        )
        return self._let_through(
            int(command_set.token), commands, ramp=float(command_set.ramp), valid_for=valid_for
        )

    def check_envelope(self, envelope: Envelope) -> SafeEnvelope:
        """The envelope as one that may be loaded; CommandRefused says which knot and why.

        Sets that refer to its slot are checked with it from now on: it must be loaded before.
        """
        check_envelope(envelope, self._bounds)
        knots = tuple(Knot(float(knot.level), float(knot.phase)) for knot in envelope.knots)
        safe = SafeEnvelope(int(envelope.slot), float(envelope.step), knots, key=_KEY)
        if knots:
            self._loaded[safe.slot] = safe
        else:
            self._loaded.pop(safe.slot, None)
        return safe

    def silence(self, token: int, channels: Collection[int], *, ramp: float) -> SafeCommandSet:
        """Level zero on these channels (and on all others, as ever); never fails.

        A channel that does not exist is left out, a ramp [s] out of range becomes the nearest in
        range, and a token that cannot be sent becomes the one after the last. Along the ramp, no
        endings.
        """
        if not is_token(token):
            token = token_after(self._last_token)
        commands = tuple(
            DriveCommand(
                channel=channel, frequency=self._idle_frequency, level=0.0, skip_ending=True
            )
            for channel in range(self._bounds.channels)
            if channel in channels
        )
        ramp = min(max(float(ramp), 0.0), self._bounds.ramp) if is_number(ramp) else 0.0
        return self._let_through(int(token), commands, ramp=ramp, valid_for=0.0)

    def check_or_silence(
        self, command_set: CommandSet, *, ramp: float
    ) -> tuple[SafeCommandSet, CommandRefused | None]:
        """The checked set and None, or silence along a ramp [s] and why.

        For the control loop: whatever goes wrong in checking, and of whatever kind, the result can
        be sent and is silent.
        """
        try:
            return self.check(command_set), None
        except Exception as problem:  # silence is right for every kind of failure
            reason = (
                problem
                if isinstance(problem, CommandRefused)
                else CommandRefused(f"{type(problem).__name__}: {problem}")
            )
            token = getattr(command_set, "token", 0)
            return self.silence(token, range(self._bounds.channels), ramp=ramp), reason

    @property
    def _idle_frequency(self) -> float:
        return self._bounds.frequency_min

    def _let_through(
        self, token: int, commands: tuple[DriveCommand, ...], *, ramp: float, valid_for: float
    ) -> SafeCommandSet:
        self._last_token = token
        fades = [ramp]
        if not all(command.skip_ending for command in commands):  # an earlier ending may play
            fades += [_duration(envelope) for envelope in self._loaded.values()]
        vibrates = any(command.level > 0 or command.onset for command in commands)
        self._budget.note(self._clock(), lasts=(valid_for or _FOREVER) if vibrates else 0.0)
        self._playing = {command.channel: command for command in commands if command.level > 0}
        return SafeCommandSet(
            token,
            commands,
            ramp=ramp,
            valid_for=valid_for,
            settled_after=max(fades),
            key=_KEY,
        )


_LONGEST = PROTOCOL.quantities.valid_for.high
_FOREVER = float("inf")


def _duration(envelope: Envelope) -> float:
    return envelope.step * (len(envelope.knots) + 1)
