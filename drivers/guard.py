"""The guard: the only maker of commands that an encoder will take.

Its limits are the least of the configuration, what the amplifier reports and the ceilings below;
nothing sets them at run time.
"""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from numbers import Integral, Real
from typing import final

from drivers.command import CommandSet, DriveCommand, Envelope, Knot, token_after
from drivers.errors import CommandError, CommandRefused
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Capabilities

# Below 10 Hz a plate on springs only rocks, nothing is felt, and the voltage stands nearly still.
FREQUENCY_FLOOR = 10.0
# What the wire can say; the skin's sensitivity to vibration has fallen off long before it.
FREQUENCY_CEILING = PROTOCOL.quantities.frequency.high
# Full stroke: beyond it the electrodes of an actuator touch.
LEVEL_CEILING = 1.0

_KEY = object()


@final
class SafeCommand(CommandSet):
    """A command set that a guard has let through; only a `Guard` can make one."""

    def __init__(
        self,
        token: int,
        commands: tuple[DriveCommand, ...],
        *,
        ramp: float,
        valid_for: float,
        key: object = None,
    ) -> None:
        if key is not _KEY:
            raise TypeError("a SafeCommand is made by Guard.check or Guard.silence, by nobody else")
        super().__init__(token=token, commands=commands, ramp=ramp, valid_for=valid_for)

    def __init_subclass__(cls) -> None:
        raise TypeError("SafeCommand cannot be subclassed")


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


@dataclass(frozen=True)
class GuardLimits:
    """What the configuration allows: mechanical frequencies [Hz] and level (1 is full stroke)."""

    frequency_min: float
    frequency_max: float
    level: float


@dataclass(frozen=True)
class _Bounds:
    """The least of all limits."""

    frequency_min: float
    frequency_max: float
    level: float
    ramp: float
    channels: int
    envelope_slots: int
    envelope_knots: int
    envelope_step_min: float
    envelope_step_max: float


def _tightest(limits: GuardLimits, capabilities: Capabilities) -> _Bounds:
    numbers = (
        *(limits.frequency_min, limits.frequency_max, limits.level),
        *(capabilities.frequency_min, capabilities.frequency_max),
        *(capabilities.level_max, capabilities.ramp_max),
    )
    if not all(math.isfinite(number) for number in numbers):
        raise CommandError(f"guard limits must be finite; got {limits} and {capabilities}")
    bounds = _Bounds(
        frequency_min=max(limits.frequency_min, capabilities.frequency_min, FREQUENCY_FLOOR),
        frequency_max=min(limits.frequency_max, capabilities.frequency_max, FREQUENCY_CEILING),
        level=min(limits.level, capabilities.level_max, LEVEL_CEILING),
        ramp=max(0.0, min(capabilities.ramp_max, PROTOCOL.quantities.ramp.high)),
        channels=min(capabilities.channels, PROTOCOL.quantities.channel_count.maximum),
        envelope_slots=capabilities.envelope_slots,
        envelope_knots=capabilities.envelope_knots,
        envelope_step_min=capabilities.envelope_step_min,
        envelope_step_max=capabilities.envelope_step_max,
    )
    if bounds.frequency_min > bounds.frequency_max:
        raise CommandError(
            "the configured limits and the amplifier's own leave no frequency: from "
            f"{bounds.frequency_min:g} to {bounds.frequency_max:g} Hz; widen limits.frequency in "
            "the rig file or use another amplifier"
        )
    if bounds.level < 0:
        raise CommandError(f"the level limit is {bounds.level:g}; it must lie between 0 and 1")
    return bounds


def _is_number(value: object) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def _is_whole(value: object, *, low: int, high: int) -> bool:
    return isinstance(value, Integral) and low <= int(value) <= high


def _is_token(value: object) -> bool:
    token = PROTOCOL.quantities.token
    return _is_whole(value, low=token.minimum, high=token.maximum)


def _check_token(command_set: CommandSet, bounds: _Bounds) -> None:
    if not _is_token(command_set.token):
        raise CommandRefused(
            f"token is {command_set.token!r}; it must be a whole number from 1 to 65535"
        )


def _check_times(command_set: CommandSet, bounds: _Bounds) -> None:
    longest = PROTOCOL.quantities.valid_for.high
    for name, value, most in (
        ("ramp", command_set.ramp, bounds.ramp),
        ("valid_for", command_set.valid_for, longest),
    ):
        if not (_is_number(value) and 0 <= value <= most):
            raise CommandRefused(f"{name} is {value!r} s; it must lie between 0 and {most:g} s")


def _check_channels(command_set: CommandSet, bounds: _Bounds) -> None:
    seen: set[int] = set()
    for command in command_set.commands:
        channel = command.channel
        if not _is_whole(channel, low=0, high=bounds.channels - 1):
            raise CommandRefused(
                f"channel {channel!r} does not exist; the amplifier has channels 0 to "
                f"{bounds.channels - 1}",
                channel=channel,
            )
        if channel in seen:
            raise CommandRefused(f"channel {channel} is named twice in one set", channel=channel)
        seen.add(channel)


def _check_finite(command_set: CommandSet, bounds: _Bounds) -> None:
    for command in command_set.commands:
        for name in ("frequency", "level", "phase"):
            value = getattr(command, name)
            if not _is_number(value):
                raise CommandRefused(
                    f"{name} of channel {command.channel} is {value!r}, not a finite number",
                    channel=command.channel,
                )


def _check_levels(command_set: CommandSet, bounds: _Bounds) -> None:
    for command in command_set.commands:
        if not 0 <= command.level <= bounds.level:
            raise CommandRefused(
                f"level of channel {command.channel} is {command.level:g}; it must lie between 0 "
                f"and {bounds.level:g}",
                channel=command.channel,
            )


def _check_frequencies(command_set: CommandSet, bounds: _Bounds) -> None:
    for command in command_set.commands:
        within = bounds.frequency_min <= command.frequency <= bounds.frequency_max
        if command.level > 0 and not within:
            raise CommandRefused(
                f"frequency of channel {command.channel} is {command.frequency:g} Hz; it must lie "
                f"between {bounds.frequency_min:g} and {bounds.frequency_max:g} Hz",
                channel=command.channel,
            )


def _check_slots(command_set: CommandSet, bounds: _Bounds) -> None:
    for command in command_set.commands:
        for name in ("onset", "ending"):
            slot = getattr(command, name)
            if not _is_whole(slot, low=0, high=bounds.envelope_slots):
                raise CommandRefused(
                    f"{name} of channel {command.channel} is slot {slot!r}; the amplifier keeps "
                    f"envelopes in slots 1 to {bounds.envelope_slots} (0 is none)",
                    channel=command.channel,
                )


# In this order; each raises CommandRefused or lets the set pass, and may rely on those before it.
_RULES: tuple[Callable[[CommandSet, _Bounds], None], ...] = (
    _check_token,
    _check_times,
    _check_channels,
    _check_finite,
    _check_levels,
    _check_frequencies,
    _check_slots,
)


@final
class Guard:
    """Lets the command sets of one amplifier through or refuses them.

    Raises CommandError for limits that leave nothing to play.
    """

    def __init__(self, limits: GuardLimits, capabilities: Capabilities) -> None:
        self._bounds = _tightest(limits, capabilities)
        self._last_token = 0

    @property
    def limits(self) -> GuardLimits:
        """The limits in force: the least of configuration, amplifier and ceilings."""
        bounds = self._bounds
        return GuardLimits(bounds.frequency_min, bounds.frequency_max, bounds.level)

    def check(self, command_set: CommandSet) -> SafeCommand:
        """The set as a command that may be sent; CommandRefused says which channel and why."""
        for rule in _RULES:
            rule(command_set, self._bounds)
        # A silent channel keeps no frequency that an amplifier could stumble over.
        commands = tuple(
            DriveCommand(
                channel=int(command.channel),
                frequency=float(command.frequency if command.level > 0 else self._idle_frequency),
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
            int(command_set.token),
            commands,
            ramp=float(command_set.ramp),
            valid_for=float(command_set.valid_for),
        )

    def check_envelope(self, envelope: Envelope) -> SafeEnvelope:
        """The envelope as one that may be loaded; CommandRefused says which knot and why."""
        bounds = self._bounds
        if not _is_whole(envelope.slot, low=1, high=bounds.envelope_slots):
            raise CommandRefused(
                f"slot is {envelope.slot!r}; the amplifier keeps envelopes in slots 1 to "
                f"{bounds.envelope_slots}"
            )
        low, high = bounds.envelope_step_min, bounds.envelope_step_max
        if not (_is_number(envelope.step) and low <= envelope.step <= high):
            raise CommandRefused(
                f"the step of an envelope is {envelope.step!r} s; it must lie between {low:g} and "
                f"{high:g} s"
            )
        if len(envelope.knots) > bounds.envelope_knots:
            raise CommandRefused(
                f"an envelope has {len(envelope.knots)} knots; the amplifier takes "
                f"{bounds.envelope_knots}"
            )
        for number, knot in enumerate(envelope.knots):
            is_finite = _is_number(knot.level) and _is_number(knot.phase)
            if not (is_finite and 0 <= knot.level <= bounds.level):
                raise CommandRefused(
                    f"knot {number} has level {knot.level!r} and phase {knot.phase!r} degrees; "
                    f"both must be finite, and the level between 0 and {bounds.level:g}"
                )
        knots = tuple(Knot(float(knot.level), float(knot.phase)) for knot in envelope.knots)
        return SafeEnvelope(int(envelope.slot), float(envelope.step), knots, key=_KEY)

    def silence(self, token: int, channels: Collection[int], *, ramp: float) -> SafeCommand:
        """Level zero on these channels (and on all others, as ever); never fails.

        A channel that does not exist is left out, a ramp [s] out of range becomes the nearest in
        range, and a token that cannot be sent becomes the one after the last. Along the ramp, no
        endings.
        """
        if not _is_token(token):
            token = token_after(self._last_token)
        commands = tuple(
            DriveCommand(
                channel=channel, frequency=self._idle_frequency, level=0.0, skip_ending=True
            )
            for channel in range(self._bounds.channels)
            if channel in channels
        )
        ramp = min(max(float(ramp), 0.0), self._bounds.ramp) if _is_number(ramp) else 0.0
        return self._let_through(int(token), commands, ramp=ramp, valid_for=0.0)

    def check_or_silence(
        self, command_set: CommandSet, *, ramp: float
    ) -> tuple[SafeCommand, str | None]:
        """The checked set and None, or silence along a ramp [s] and the reason.

        For the control loop: whatever goes wrong in checking, and of whatever kind, the result can
        be sent and is silent.
        """
        try:
            return self.check(command_set), None
        except Exception as problem:  # silence is right for every kind of failure
            reason = f"{type(problem).__name__}: {problem}"
            token = getattr(command_set, "token", 0)
            return self.silence(token, range(self._bounds.channels), ramp=ramp), reason

    @property
    def _idle_frequency(self) -> float:
        return self._bounds.frequency_min

    def _let_through(
        self, token: int, commands: tuple[DriveCommand, ...], *, ramp: float, valid_for: float
    ) -> SafeCommand:
        self._last_token = token
        return SafeCommand(token, commands, ramp=ramp, valid_for=valid_for, key=_KEY)
