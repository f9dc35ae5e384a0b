"""Reasons of refusals, in words."""

from drivers.errors import CommandRefused
from drivers.protocol.messages import Disarm, Nak, NakCode, Reply, Request, Stop

_REASONS = {
    NakCode.UNKNOWN_TYPE: "it does not support this request",
    NakCode.BAD_LENGTH: "wrong payload length; its firmware version may differ",
    NakCode.BAD_VALUE: "a value is out of its range",
    NakCode.BAD_CHANNEL: "no such channel, or the channel occurs twice",
    NakCode.WRONG_STATE: "it is not armed, its interlock is open, or it is stopped or in a fault; "
    "read its status, then clear it",
    NakCode.BAD_TOKEN: "no set is staged under this token",
    NakCode.BUSY: "busy after 3 attempts; try again",
    NakCode.NO_ENVELOPE: "a slot of the set holds no envelope",
    NakCode.UNSUPPORTED_VERSION: "its protocol version differs",
    NakCode.WRONG_SESSION: "another host has armed it, or it has been armed anew; disarm it, then "
    "arm it again",
    NakCode.WRONG_LATCH: "a newer stop or fault has come; read its status, then clear that",
    NakCode.FADING: "as many voices sound on the channel as it has; wait for the end of the ramp",
}

PROTOCOL_VIOLATION = (
    "its firmware violates the protocol: update it; era amp conformance lists every violation"
)
"""Remedy for an invalid reply."""


_STOP_REFUSED = "outputs must fall silent in every state; switch it off, and update its firmware"


def refusal(request: Request, nak: Nak, *, may_play: bool) -> CommandRefused:
    """Make the error of a refused request; may_play: see `CommandRefused`."""
    where = "" if nak.channel is None else f" (channel {nak.channel})"
    is_stop = isinstance(request, Stop | Disarm) and nak.code is not NakCode.BUSY
    return CommandRefused(
        f"the amplifier refused {type(request).__name__}{where}: "
        f"{_STOP_REFUSED if is_stop else _REASONS[nak.code]}",
        channel=nak.channel,
        may_play=may_play,
    )


def is_busy(reply: Reply) -> bool:
    """Whether the request may succeed if repeated."""
    return isinstance(reply, Nak) and reply.code is NakCode.BUSY
