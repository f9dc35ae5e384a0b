"""The guard: the only maker of command sets that encoders accept.

Its limits are fixed at construction, see `drivers.guard.limits`.
"""

from collections.abc import Callable, Collection
from typing import final

from drivers.clock import now
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandRefused
from drivers.guard.budget import Budget
from drivers.guard.limits import GuardLimits, capabilities_in_force, limits_in_force
from drivers.guard.rules import GuardContext, check_envelope, check_set, is_finite, is_token
from drivers.protocol.definition import PROTOCOL, token_after
from drivers.protocol.messages import Capabilities

_KEY = object()


@final
class SafeCommandSet(CommandSet):
    """A command set that has passed a guard; only a `Guard` can make one.

    settled_after [s]: time from its commit until all ramps and envelopes have ended.
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
            raise TypeError("SafeCommandSet must be made by Guard.check or Guard.silence")
        super().__init__(token=token, commands=commands, ramp=ramp, valid_for=valid_for)
        object.__setattr__(self, "settled_after", settled_after)

    def __init_subclass__(cls) -> None:
        raise TypeError("SafeCommandSet cannot be subclassed")


@final
class SafeEnvelope(Envelope):
    """An envelope that has passed a guard; only a `Guard` can make one."""

    def __init__(
        self, slot: int, step: float, knots: tuple[Knot, ...], *, key: object = None
    ) -> None:
        if key is not _KEY:
            raise TypeError("SafeEnvelope must be made by Guard.check_envelope")
        super().__init__(slot=slot, step=step, knots=knots)

    def __init_subclass__(cls) -> None:
        raise TypeError("SafeEnvelope cannot be subclassed")


@final
class Guard:
    """Checks the command sets of one amplifier.

    limits: the configured ones. clock [s]: for rate,
    on-time and duty, the event loop's by default. Raises CommandError for limits that leave nothing
    to play.
    """

    def __init__(
        self,
        limits: GuardLimits,
        capabilities: Capabilities,
        *,
        clock: Callable[[], float] = now,
    ) -> None:
        self._limits = limits_in_force(limits, capabilities)
        self._capabilities = capabilities_in_force(capabilities)
        self._clock = clock
        self._budget = Budget(self._limits)
        self._last_token = 0
        self._playing: dict[int, DriveCommand] = {}
        self._loaded: dict[int, SafeEnvelope] = {}

    @property
    def limits(self) -> GuardLimits:
        """The limits in force: the least of configuration, amplifier and ceilings."""
        return self._limits

    def check(self, command_set: CommandSet) -> SafeCommandSet:
        """Check a set. Raises CommandRefused with channel and reason.

        valid_for is shortened to the on-time and duty that are left.
        """
        check_set(command_set, self._context)
        valid_for = float(command_set.valid_for)
        shaped = any(command.onset for command in command_set.commands)
        if shaped or not command_set.is_silent:
            remaining = self._budget.remaining(self._clock())
            if remaining is not None:
                valid_for = min(valid_for or remaining, remaining, _MAX_VALID_FOR)
        # A silent channel gets a frequency that the amplifier accepts.
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
        return self._make_safe(
            int(command_set.token), commands, ramp=float(command_set.ramp), valid_for=valid_for
        )

    def check_envelope(self, envelope: Envelope) -> SafeEnvelope:
        """Check an envelope. Raises CommandRefused with knot and reason.

        Sets that refer to its slot are checked with it from now on: load it before them.
        """
        check_envelope(envelope, self._context)
        knots = tuple(Knot(float(knot.level), float(knot.phase)) for knot in envelope.knots)
        safe = SafeEnvelope(int(envelope.slot), float(envelope.step), knots, key=_KEY)
        if knots:
            self._loaded[safe.slot] = safe
        else:
            self._loaded.pop(safe.slot, None)
        return safe

    def silence(self, token: int, channels: Collection[int], *, ramp: float) -> SafeCommandSet:
        """Make a set with level zero on these channels; never fails.

        Channels not listed are silenced as well; an invalid token becomes the next valid one.
        Unknown channels are skipped, a ramp [s] is clipped into range, no endings are played.
        """
        if not is_token(token):
            token = token_after(self._last_token)
        commands = tuple(
            DriveCommand(
                channel=channel, frequency=self._idle_frequency, level=0.0, skip_ending=True
            )
            for channel in range(self._capabilities.channels)
            if channel in channels
        )
        ramp = min(max(float(ramp), 0.0), self._capabilities.ramp_max) if is_finite(ramp) else 0.0
        return self._make_safe(int(token), commands, ramp=ramp, valid_for=0.0)

    def check_or_silence(
        self, command_set: CommandSet, *, ramp: float
    ) -> tuple[SafeCommandSet, CommandRefused | None]:
        """Return the checked set and None, or silence along a ramp [s] and the reason.

        For the control loop: any exception in checking becomes a silent set that can be sent.
        """
        try:
            return self.check(command_set), None
        except Exception as problem:  # every failure means silence
            reason = (
                problem
                if isinstance(problem, CommandRefused)
                else CommandRefused(f"{type(problem).__name__}: {problem}")
            )
            token = getattr(command_set, "token", 0)
            return self.silence(token, range(self._capabilities.channels), ramp=ramp), reason

    @property
    def _idle_frequency(self) -> float:
        return self._limits.frequency_min

    @property
    def _context(self) -> GuardContext:
        return GuardContext(self._limits, self._capabilities, self._playing, self._loaded)

    def _make_safe(
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


_MAX_VALID_FOR = PROTOCOL.quantities.valid_for.high
_FOREVER = float("inf")


def _duration(envelope: Envelope) -> float:
    return envelope.step * (len(envelope.knots) + 1)
