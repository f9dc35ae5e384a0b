"""The DBC file of an amplifier and its host, for bus monitors.

Signals are the words of a frame, because their meaning depends on the message. The file is ASCII,
the only encoding that all DBC readers accept.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from drivers.protocol.definition import (
    EVENT,
    FAULTS,
    HELLO,
    MAX_WORDS,
    MESSAGES,
    NAK,
    STATES,
    VERSION,
)
from drivers.wires.can_frames import CANOPEN, REPLY, REQUEST, cob_id, frames_of

_HOST, _AMPLIFIER = "Host", "Amplifier"
_TYPES = {"Hello": HELLO, **{name: each.number for name, each in MESSAGES.items()}}
_VALUES: Mapping[str, Mapping[str, int]] = {
    "type": {**_TYPES, "Event": EVENT, "Nak": NAK},
    **{"state": STATES, "fault": FAULTS},
    **{"nmt_state": CANOPEN["nmt_states"], "nmt_command": CANOPEN["nmt"]},
}


@dataclass(frozen=True)
class _Signal:
    """A signal of a frame: first bit, number of bits, and its multiplexer indicator (`mark`)."""

    name: str
    first: int
    bits: int
    mark: str = ""


def _words() -> Iterator[_Signal]:
    """Yield the signals of the frames of a message, multiplexed by the index in byte 1."""
    yield _Signal("number", 0, 8)
    yield _Signal("frame", 8, 8, "M ")
    yield _Signal("type", 16, 8, "m0 ")
    yield _Signal("words", 24, 8, "m0 ")
    yield from (_Signal(f"word_{at}", 32 + 16 * at, 16, "m0 ") for at in range(2))
    for frame in range(1, frames_of(MAX_WORDS)):
        for place in range(3):
            at = 3 * frame - 1 + place
            if at < MAX_WORDS:
                yield _Signal(f"word_{at}", 16 + 16 * place, 16, f"m{frame} ")


def dbc_text(*, node: int = 1) -> str:
    """Return the DBC file for the host and an amplifier with a node number."""
    words = (*_words(),)
    emergency = (
        *(_Signal("code", 0, 16), _Signal("error_register", 16, 8), _Signal("state", 24, 4)),
        *(_Signal("fault", 28, 4), _Signal("channel", 32, 8)),
    )
    frames = (
        (0, "Nmt", 2, _HOST, (_Signal("nmt_command", 0, 8), _Signal("node", 8, 8))),
        (cob_id("emergency", node), "Emergency", 8, _AMPLIFIER, emergency),
        (REQUEST, "Broadcast", 8, _HOST, words),
        (REQUEST + node, "Request", 8, _HOST, words),
        (REPLY + node, "Reply", 8, _AMPLIFIER, words),
        (cob_id("heartbeat", node), "Heartbeat", 1, _AMPLIFIER, (_Signal("nmt_state", 0, 8),)),
    )
    lines = [f'VERSION "{VERSION}"', "", "NS_ :", "", "BS_:", "", f"BU_: {_HOST} {_AMPLIFIER}", ""]
    named = []
    for identifier, name, length, sender, signals in frames:
        receiver = _AMPLIFIER if sender == _HOST else _HOST
        lines.append(f"BO_ {identifier} {name}: {length} {sender}")
        for each in signals:
            place = f"{each.first}|{each.bits}@1+ (1,0) [0|{(1 << each.bits) - 1}]"
            lines.append(f' SG_ {each.name} {each.mark}: {place} "" {receiver}')
            if each.name in _VALUES:
                shown = " ".join(f'{value} "{key}"' for key, value in _VALUES[each.name].items())
                named.append(f"VAL_ {identifier} {each.name} {shown} ;")
        lines.append("")
    return "\n".join([*lines, *named, ""])
