"""What a guard asks of a set or an envelope by itself: each rule lets it pass or raises.

    finite -> frequency and level in range -> envelopes that are loaded -> slew -> total power

Every rule may rely on those before it. Limits over time are `drivers.guard.budget`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from numbers import Integral, Real

from drivers.command import CommandSet, DriveCommand, Envelope
from drivers.errors import CommandRefused
from drivers.guard.limits import Bounds
from drivers.protocol.definition import PROTOCOL

_SLACK = 1 + 1e-9  # sums of floats


@dataclass(frozen=True)
class Known:
    """What a guard knows besides the set: what plays, by channel, and what is loaded, by slot."""

    playing: Mapping[int, DriveCommand]
    loaded: Mapping[int, Envelope]


def check_set(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
    """Raise CommandRefused for the first rule that the set breaks."""
    for rule in _RULES:
        rule(command_set, bounds, known)


def check_envelope(envelope: Envelope, bounds: Bounds) -> None:
    """Raise CommandRefused for an envelope that must not, or cannot, be played."""
    if not _is_whole(envelope.slot, low=1, high=bounds.envelope_slots):
        raise CommandRefused(
            f"slot is {envelope.slot!r}; the amplifier keeps envelopes in slots 1 to "
            f"{bounds.envelope_slots}"
        )
    low, high = bounds.envelope_step_min, bounds.envelope_step_max
    if not (is_number(envelope.step) and low <= envelope.step <= high):
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
        is_finite = is_number(knot.level) and is_number(knot.phase)
        if not (is_finite and 0 <= knot.level <= bounds.level):
            raise CommandRefused(
                f"knot {number} has level {knot.level!r} and phase {knot.phase!r} degrees; "
                f"both must be finite, and the level between 0 and {bounds.level:g}"
            )
    levels = [knot.level for knot in envelope.knots]
    _check_rises(levels, envelope.step, bounds, what=f"the envelope of slot {envelope.slot}")


def is_number(value: object) -> bool:
    """Whether it is a finite real number."""
    return isinstance(value, Real) and math.isfinite(value)


def is_token(value: object) -> bool:
    """Whether it can name a set."""
    token = PROTOCOL.quantities.token
    return _is_whole(value, low=token.minimum, high=token.maximum)


def _is_whole(value: object, *, low: int, high: int) -> bool:
    return isinstance(value, Integral) and low <= int(value) <= high


def _check_token(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
    if not is_token(command_set.token):
        raise CommandRefused(
            f"token is {command_set.token!r}; it must be a whole number from 1 to 65535"
        )


def _check_times(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
    longest = PROTOCOL.quantities.valid_for.high
    for name, value, most in (
        ("ramp", command_set.ramp, bounds.ramp),
        ("valid_for", command_set.valid_for, longest),
    ):
        if not (is_number(value) and 0 <= value <= most):
            raise CommandRefused(f"{name} is {value!r} s; it must lie between 0 and {most:g} s")


def _check_channels(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
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


def _check_finite(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
    for command in command_set.commands:
        for name in ("frequency", "level", "phase"):
            value = getattr(command, name)
            if not is_number(value):
                raise CommandRefused(
                    f"{name} of channel {command.channel} is {value!r}, not a finite number",
                    channel=command.channel,
                )


def _check_levels(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
    for command in command_set.commands:
        if not 0 <= command.level <= bounds.level:
            raise CommandRefused(
                f"level of channel {command.channel} is {command.level:g}; it must lie between 0 "
                f"and {bounds.level:g}",
                channel=command.channel,
            )


def _check_frequencies(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
    for command in command_set.commands:
        within = bounds.frequency_min <= command.frequency <= bounds.frequency_max
        if (command.level > 0 or command.onset) and not within:
            raise CommandRefused(
                f"frequency of channel {command.channel} is {command.frequency:g} Hz; it must lie "
                f"between {bounds.frequency_min:g} and {bounds.frequency_max:g} Hz",
                channel=command.channel,
            )


def _check_slots(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
    for command in command_set.commands:
        for name in ("onset", "ending"):
            slot = getattr(command, name)
            if not _is_whole(slot, low=0, high=bounds.envelope_slots):
                raise CommandRefused(
                    f"{name} of channel {command.channel} is slot {slot!r}; the amplifier keeps "
                    f"envelopes in slots 1 to {bounds.envelope_slots} (0 is none)",
                    channel=command.channel,
                )
            if slot and slot not in known.loaded:
                raise CommandRefused(
                    f"{name} of channel {command.channel} is slot {slot}, in which this guard has "
                    "seen no envelope; load one first",
                    channel=command.channel,
                )


def _check_slew(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
    for command in command_set.commands:
        before = known.playing.get(command.channel)
        goes_on = before is not None and before.frequency == command.frequency
        begin = before.level if before is not None and goes_on else 0.0
        onset = known.loaded.get(command.onset)
        what = f"channel {command.channel}"
        if onset is None:
            _check_rises([begin, command.level], command_set.ramp, bounds, what=what)
        else:
            levels = [begin if command.keep_phase else 0.0, *(knot.level for knot in onset.knots)]
            _check_rises([*levels, command.level], onset.step, bounds, what=what)


def _check_rises(levels: Sequence[float], step: float, bounds: Bounds, *, what: str) -> None:
    steepest = max((there - here for here, there in pairwise(levels)), default=0.0)
    if steepest > bounds.slew * step * _SLACK:
        raise CommandRefused(
            f"{what} would rise by {steepest:g} of full stroke within {step:g} s; at most "
            f"{bounds.slew:g} a second is allowed: use a longer ramp"
        )


def _check_power(command_set: CommandSet, bounds: Bounds, known: Known) -> None:
    def highest(command: DriveCommand) -> float:
        shapes = [known.loaded[slot] for slot in (command.onset, command.ending) if slot]
        return max([command.level, *(knot.level for shape in shapes for knot in shape.knots)])

    power = sum(highest(command) ** 2 for command in command_set.commands)
    if power > bounds.power * _SLACK:
        raise CommandRefused(
            f"the squares of all levels add up to {power:g}; at most {bounds.power:g} is allowed: "
            "lower the levels, or drive fewer channels at once"
        )


_RULES: tuple[Callable[[CommandSet, Bounds, Known], None], ...] = (
    _check_token,
    _check_times,
    _check_channels,
    _check_finite,
    _check_levels,
    _check_frequencies,
    _check_slots,
    _check_slew,
    _check_power,
)
