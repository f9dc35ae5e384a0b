"""What an amplifier's refusal means, in words."""

from drivers.errors import CommandRefused
from drivers.protocol.messages import Nak, NakCode, Reply

_REASONS = {
    NakCode.UNKNOWN_TYPE: "it does not know this kind of request",
    NakCode.BAD_LENGTH: "it read a request of another length; its firmware may be too old or new",
    NakCode.BAD_VALUE: "a value is out of the range that it can play",
    NakCode.BAD_CHANNEL: "it has no such channel, or the channel was named twice",
    NakCode.WRONG_STATE: "it is not armed, or it is stopped or in a fault until that is cleared; "
    "ask for its status",
    NakCode.BAD_TOKEN: "no set is staged under this token",
    NakCode.BUSY: "it was busy three times in a row; try again",
    NakCode.NO_ENVELOPE: "no envelope is loaded in a slot that the set refers to",
    NakCode.UNSUPPORTED_VERSION: "it speaks another version of the protocol",
}

NO_PROTOCOL = (
    "its firmware does not keep to the protocol: update it; era amp conformance tells what else it "
    "does otherwise"
)
"""What to say of an amplifier whose answer is none."""


def refusal(request: str, nak: Nak) -> CommandRefused:
    """The error for a refused request of this name."""
    where = "" if nak.channel is None else f" (channel {nak.channel})"
    return CommandRefused(
        f"the amplifier refused {request}{where}: {_REASONS[nak.code]}", channel=nak.channel
    )


def is_busy(reply: Reply) -> bool:
    """Whether the same request may be taken a moment later."""
    return isinstance(reply, Nak) and reply.code is NakCode.BUSY
