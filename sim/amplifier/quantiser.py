"""Check commands against capabilities, and round them to the steps of the protocol."""

from dataclasses import replace

from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.errors import CommandError
from drivers.protocol.definition import PROTOCOL, Quantity
from drivers.protocol.messages import Capabilities, Nak, NakCode

_Q = PROTOCOL.quantities


class RefusedSet(Exception):
    """A set or an envelope that is refused with a Nak."""

    def __init__(self, code: NakCode, channel: int | None = None) -> None:
        super().__init__(code.name)
        self.nak = Nak(code, channel)


def quantise_set(wanted: CommandSet, capabilities: Capabilities) -> CommandSet:
    """The set as it will be played; raises RefusedSet.

    The frequency of a silent channel may be out of range.
    """
    if not _Q.token.holds(wanted.token):
        raise RefusedSet(NakCode.BAD_TOKEN)
    channels = [command.channel for command in wanted.commands]
    for channel in channels:
        if not 0 <= channel < capabilities.channels or channels.count(channel) > 1:
            raise RefusedSet(NakCode.BAD_CHANNEL, channel)
    return CommandSet(
        token=wanted.token,
        commands=tuple(_quantised(command, capabilities) for command in wanted.commands),
        ramp=_in_steps(_Q.ramp, wanted.ramp),
        valid_for=_in_steps(_Q.valid_for, wanted.valid_for),
    )


def quantise_envelope(wanted: Envelope, capabilities: Capabilities) -> Envelope:
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


def _quantised(command: DriveCommand, capabilities: Capabilities) -> DriveCommand:
    played = replace(
        command,
        frequency=_in_steps(_Q.frequency, command.frequency, channel=command.channel),
        level=_in_steps(_Q.level, command.level, channel=command.channel),
        phase=_in_steps(_Q.phase, command.phase, channel=command.channel),
    )
    low, high = capabilities.frequency_min, capabilities.frequency_max
    if played.level > 0 and not low <= played.frequency <= high:
        raise RefusedSet(NakCode.BAD_VALUE, command.channel)
    return played


def _in_steps(quantity: Quantity, value: float, *, channel: int | None = None) -> float:
    try:
        return quantity.quantise(value)
    except CommandError as error:
        raise RefusedSet(NakCode.BAD_VALUE, channel) from error
