"""The guard, and what encoders accept: sets and envelopes that passed it, or made of these.

Its limits are fixed at construction, see `drivers.guard.limits`.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import final

from drivers.clock import now
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandError, CommandRefused
from drivers.guard.channel_state import duration
from drivers.guard.limits import capabilities_in_force, limits_in_force
from drivers.guard.record import PlayRecord, skips_endings, vibrates
from drivers.guard.rounding import rounded_down, rounded_envelope, rounded_set
from drivers.guard.rules import (
    GuardContext,
    check_envelope,
    check_power,
    check_set,
    is_finite,
    is_token,
)
from drivers.guard.voltage import checked_knot, checked_voltage
from drivers.protocol.definition import PROTOCOL, token_after
from drivers.protocol.messages import Capabilities, ChannelLimits, Feature
from registry.limits import GuardLimits

_KEY = object()
_Q = PROTOCOL.quantities


@final
class SafeCommandSet(CommandSet):
    """A command set that has passed a guard, of motion, or of voltage made of one that has.

    Made only in this module: by a `Guard`, and by `safe_voltages`.

    settled_after [s]: time from its commit until all ramps and envelopes have ended; record: of the
    guard, for `Amplifier`.
    """

    settled_after: float
    record: PlayRecord

    def __init__(
        self,
        token: int,
        commands: tuple[DriveCommand, ...],
        *,
        ramp: float,
        valid_for: float,
        settled_after: float = 0.0,
        record: PlayRecord | None = None,
        key: object = None,
    ) -> None:
        if key is not _KEY or record is None:
            raise TypeError(
                "SafeCommandSet must be made by Guard.check, Guard.silence or safe_voltages"
            )
        super().__init__(token=token, commands=commands, ramp=ramp, valid_for=valid_for)
        object.__setattr__(self, "settled_after", settled_after)
        object.__setattr__(self, "record", record)

    def __init_subclass__(cls) -> None:
        raise TypeError("SafeCommandSet cannot be subclassed")


def safe_voltages(
    safe: SafeCommandSet, commands: Sequence[DriveCommand], limits: Sequence[ChannelLimits]
) -> SafeCommandSet:
    """Return a set that passed its guard with its commands converted to voltage, if within limits.

    Levels, frequencies and phases may differ; silence, envelopes and flags may not. limits: by
    channel, see `checked_voltage`. Raises CommandRefused.
    """
    channels, requested = ([one.channel for one in each] for each in (commands, safe.commands))
    if channels != requested:
        raise CommandRefused(f"channels of the voltages must be {requested}, got {channels}")
    return SafeCommandSet(
        safe.token,
        tuple(
            checked_voltage(command, passed, limits[passed.channel])
            for command, passed in zip(commands, safe.commands, strict=True)
        ),
        ramp=safe.ramp,
        valid_for=safe.valid_for,
        settled_after=safe.settled_after,
        record=safe.record,
        key=_KEY,
    )


@final
class SafeEnvelope(Envelope):
    """An envelope that has passed a guard, or one of voltage made of it by `safe_voltage_envelope`.

    record: of the guard.
    """

    record: PlayRecord

    def __init__(
        self,
        slot: int,
        step: float,
        knots: tuple[Knot, ...],
        *,
        record: PlayRecord | None = None,
        key: object = None,
    ) -> None:
        if key is not _KEY or record is None:
            raise TypeError(
                "SafeEnvelope must be made by Guard.check_envelope or safe_voltage_envelope"
            )
        super().__init__(slot=slot, step=step, knots=knots)
        object.__setattr__(self, "record", record)

    def __init_subclass__(cls) -> None:
        raise TypeError("SafeEnvelope cannot be subclassed")


def safe_voltage_envelope(
    safe: SafeEnvelope, knots: Sequence[Knot], limits: ChannelLimits
) -> SafeEnvelope:
    """Return an envelope that passed its guard with its knots converted to voltage, if within.

    limits: of its channel. Raises CommandRefused.
    """
    if len(knots) != len(safe.knots):
        raise CommandRefused(f"knots of the voltage must be {len(safe.knots)}, got {len(knots)}")
    return SafeEnvelope(
        safe.slot,
        safe.step,
        tuple(
            checked_knot(knot, passed, limits, slot=safe.slot)
            for knot, passed in zip(knots, safe.knots, strict=True)
        ),
        record=safe.record,
        key=_KEY,
    )


@final
class Guard:
    """Checks the command sets of one amplifier.

    limits: the configured ones. clock [s]: the event loop's by default. Raises CommandError for
    limits that leave nothing to play. Checking a set changes nothing: `Amplifier` records in
    `SafeCommandSet.record` what it sends and what is confirmed.
    """

    def __init__(
        self,
        limits: GuardLimits,
        capabilities: Capabilities,
        *,
        clock: Callable[[], float] = now,
    ) -> None:
        self._made_for = (limits, capabilities)
        self._limits = limits_in_force(limits, capabilities)
        if Feature.VOLTAGE in capabilities.features:
            raise CommandError(
                "levels must be of the full stroke, got an amplifier whose levels are of a "
                "voltage; give each of its ERAs a `voltage` section in the rig file"
            )
        is_bounded = self._limits.on_time < math.inf or self._limits.duty < 1
        if is_bounded and Feature.VALID_FOR not in capabilities.features:
            raise CommandError(
                "limits of on-time and duty need an amplifier that ends vibrations itself "
                "(valid_for), got one that does not; remove them from the rig file, or use another"
            )
        self._capabilities = capabilities_in_force(capabilities)
        self._record = PlayRecord(self._limits, self._capabilities, clock)

    @property
    def limits(self) -> GuardLimits:
        """The limits in force: the least of configuration, amplifier and ceilings."""
        return self._limits

    @property
    def ramp_max(self) -> float:
        """Longest ramp [s] of the amplifier."""
        return self._capabilities.ramp_max

    def is_for(self, limits: GuardLimits, capabilities: Capabilities) -> bool:
        """Whether it was made for these limits and capabilities."""
        return self._made_for == (limits, capabilities)

    def check(self, command_set: CommandSet) -> SafeCommandSet:
        """Check a set. Raises CommandRefused with channel and reason.

        It is checked as the wire rounds it, ramps upward. valid_for is shortened to the on-time and
        duty that are left; a set that is sent later is checked again then.
        """
        context = self._context
        check_set(command_set, context)
        rounded = rounded_set(
            command_set, idle_frequency=self._idle_frequency, ramp_max=self.ramp_max
        )
        check_power(rounded, context)
        remaining = self._record.check(rounded, ramp=rounded.ramp)
        valid_for = rounded.valid_for
        if vibrates(rounded) and remaining != float("inf"):
            valid_for = min(valid_for or remaining, remaining, _Q.valid_for.high)
            valid_for = rounded_down(valid_for, _Q.valid_for)  # 0 means without end
            if valid_for <= 0:
                raise CommandRefused("on-time or duty limit reached; pause the vibration")
            rounded = replace(rounded, valid_for=valid_for)
        elif not vibrates(rounded):
            rounded = replace(rounded, ramp=self._shortened(rounded.ramp))
        return self._make_safe(rounded)

    def check_envelope(self, envelope: Envelope) -> SafeEnvelope:
        """Check an envelope. Raises CommandRefused with knot and reason.

        Sets that refer to its slot are checked with it too from now on: load it before them.
        """
        check_envelope(envelope, self._context)
        rounded = rounded_envelope(envelope)
        safe = SafeEnvelope(
            rounded.slot, rounded.step, rounded.knots, record=self._record, key=_KEY
        )
        check_envelope(safe, self._context)
        self._record.expect_load(safe)
        return safe

    def silence(self, token: int, channels: Collection[int], *, ramp: float) -> SafeCommandSet:
        """Make a set with level zero on these channels; never fails.

        Channels not listed are silenced as well; an invalid token becomes the next valid one.
        Unknown channels are skipped, no endings are played. A ramp [s] is clipped into range, and
        to the on-time and duty that are left.
        """
        if not is_token(token):
            token = token_after(self._record.last_token)
        commands = tuple(
            DriveCommand(
                channel=channel, frequency=self._idle_frequency, level=0.0, skip_ending=True
            )
            for channel in range(self._capabilities.channels)
            if channel in channels
        )
        ramp = min(max(float(ramp), 0.0), self._capabilities.ramp_max) if is_finite(ramp) else 0.0
        silent = CommandSet(int(token), commands, ramp=self._shortened(ramp), valid_for=0.0)
        return self._make_safe(silent)

    def check_or_silence(
        self, command_set: CommandSet, *, ramp: float
    ) -> tuple[SafeCommandSet, CommandRefused | None]:
        """Return the checked set and None, or silence along a ramp [s] and the reason.

        For the control loop: any exception in checking becomes a silent set that can be sent.
        """
        try:
            return self.check(command_set), None
        except Exception as error:  # every failure means silence
            reason = (
                error
                if isinstance(error, CommandRefused)
                else CommandRefused(f"{type(error).__name__}: {error}")
            )
            token = getattr(command_set, "token", 0)
            return self.silence(token, range(self._capabilities.channels), ramp=ramp), reason

    @property
    def _idle_frequency(self) -> float:
        return self._limits.frequency_min

    @property
    def _context(self) -> GuardContext:
        return GuardContext(self._limits, self._capabilities, self._record.slots)

    def _shortened(self, ramp: float) -> float:
        """Return the ramp [s] of a silent set, shortened to the on-time and duty that are left."""
        left = self._record.fade_left()
        if ramp <= left:
            return ramp
        return rounded_down(left, _Q.ramp)

    def _make_safe(self, command_set: CommandSet) -> SafeCommandSet:
        fades = [command_set.ramp]
        if not skips_endings(command_set):  # an earlier ending may play
            fades += [
                duration(envelope)
                for several in self._record.slots.values()
                for envelope in several
            ]
        return SafeCommandSet(
            command_set.token,
            command_set.commands,
            ramp=command_set.ramp,
            valid_for=command_set.valid_for,
            settled_after=max(fades),
            record=self._record,
            key=_KEY,
        )
