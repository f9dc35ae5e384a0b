"""Whether a simulated amplifier can play a set, and what it makes of it with its finite steps."""

from dataclasses import replace

from drivers.command import CommandSet, DriveCommand
from drivers.errors import CommandError
from drivers.protocol.definition import PROTOCOL, Quantity
from drivers.protocol.messages import Capabilities, Nak, NakCode

_Q = PROTOCOL.quantities


class RefusedSet(Exception):
    """A set that cannot be played; nak says why."""

    def __init__(self, code: NakCode, channel: int | None = None) -> None:
        super().__init__(code.name)
        self.nak = Nak(code, channel)


def check_and_quantise(wanted: CommandSet, capabilities: Capabilities) -> CommandSet:
    """The set as it will really be played; raises RefusedSet if any part of it cannot be.

    Every number is rounded to the step of the protocol, as any wire would. The frequency of a
    silent channel may lie outside what the amplifier can play.
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
