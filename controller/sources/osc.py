"""Open Sound Control messages out of a datagram that anybody may have sent.

python-osc reads the messages. Its reader of bundles is not used: an element of negative size makes
it loop for ever and deep nesting overflows the stack. So the bundle is opened here, strictly; and
argument types that it would write to the root logger about are refused before it sees them.
"""

from functools import lru_cache

from pythonosc.osc_message import OscMessage
from pythonosc.osc_message import ParseError as MessageError

_BUNDLE = b"#bundle\0"
_BUNDLE_HEADER = len(_BUNDLE) + 8  # the time tag is not used: touches are for now


class OscError(ValueError):
    """Bytes that are no OSC message or flat bundle of messages."""


def osc_messages(datagram: bytes, *, address: str) -> list[tuple[str | int | float, ...]]:
    """Arguments of every message to an address, in their order in the datagram.

    Only arguments of type string, int32 and float32 are read; messages to other addresses are
    passed over unread. Raises OscError; then nothing of the datagram is to be used.
    """
    wanted = _padded(address)
    return [
        _arguments(element, len(wanted))
        for element in _elements(datagram)
        if element.startswith(wanted)
    ]


def _padded(text: str) -> bytes:
    """An OSC string: zero-terminated and filled up to a multiple of four bytes."""
    raw = text.encode()
    return raw + b"\0" * (4 - len(raw) % 4)


def _elements(datagram: bytes) -> list[bytes]:
    """The messages in a datagram as bytes, not yet understood."""
    if not datagram.startswith(_BUNDLE):
        elements = [datagram]
    elif len(datagram) < _BUNDLE_HEADER:
        raise OscError("the bundle ends within its header")
    else:
        elements = []
        offset = _BUNDLE_HEADER
        while offset < len(datagram):
            size = int.from_bytes(datagram[offset : offset + 4], "big", signed=True)
            offset += 4
            if not 0 < size <= len(datagram) - offset:
                raise OscError(f"a bundle element of {size} bytes where less or more are left")
            elements.append(datagram[offset : offset + size])
            offset += size
    for element in elements:
        if not element.startswith(b"/"):
            raise OscError("an element is no OSC message")
    return elements


# Most of what a panel says it has said before: its name, who is down, fingers that rest.
@lru_cache(maxsize=256)
def _arguments(message: bytes, offset: int) -> tuple[str | int | float, ...]:
    """Arguments of one message whose type tags begin at an offset."""
    end = message.find(b"\0", offset)
    tags = message[offset:end] if end > 0 else b""
    if not tags.startswith(b",") or tags.strip(b"ifs") != b",":
        raise OscError(f"argument types {tags[:32]!r}, expected ',' and letters i, f, s")
    try:
        return tuple(OscMessage(message))
    except (MessageError, ValueError) as error:
        raise OscError(f"unreadable message: {error}") from error
