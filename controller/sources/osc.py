"""Open Sound Control messages from untrusted datagrams.

python-osc decodes the messages. Its bundle reader is not used: an element of negative size makes it
loop forever, and deep nesting overflows the stack. So bundles are opened here, strictly, and
argument types are refused that it would report to the root logger.
"""

from functools import lru_cache

from pythonosc.osc_message import OscMessage
from pythonosc.osc_message import ParseError as MessageError

_BUNDLE = b"#bundle\0"
_BUNDLE_HEADER = len(_BUNDLE) + 8  # the time tag is ignored: touches are current


class OscError(ValueError):
    """A datagram that is no OSC message or flat bundle of messages."""


def osc_messages(datagram: bytes, *, address: str) -> list[tuple[str | int | float, ...]]:
    """Return the arguments of every message to an address, in order.

    Arguments may be string, int32 and float32; messages to other addresses are skipped. Raises
    OscError for a datagram that must be ignored as a whole.
    """
    expected = _padded(address)
    return [
        _arguments(element, len(expected))
        for element in _elements(datagram)
        if element.startswith(expected)
    ]


def _padded(text: str) -> bytes:
    """Encode an OSC string: zero-terminated, padded to a multiple of four bytes."""
    raw = text.encode()
    return raw + b"\0" * (4 - len(raw) % 4)


def _elements(datagram: bytes) -> list[bytes]:
    """Split a datagram into encoded messages."""
    if not datagram.startswith(_BUNDLE):
        elements = [datagram]
    elif len(datagram) < _BUNDLE_HEADER:
        raise OscError("bundle must have a complete header")
    else:
        elements = []
        offset = _BUNDLE_HEADER
        while offset < len(datagram):
            size = int.from_bytes(datagram[offset : offset + 4], "big", signed=True)
            offset += 4
            if not 0 < size <= len(datagram) - offset:
                raise OscError(f"size of a bundle element must fit its bundle, got {size}")
            elements.append(datagram[offset : offset + size])
            offset += size
    for element in elements:
        if not element.startswith(b"/"):
            raise OscError("element must be an OSC message")
    return elements


# Most messages of a panel repeat: its name, the contacts that are alive, resting fingers.
@lru_cache(maxsize=256)
def _arguments(message: bytes, offset: int) -> tuple[str | int | float, ...]:
    """Decode the arguments of a message whose type tags start at an offset."""
    end = message.find(b"\0", offset)
    tags = message[offset:end] if end > 0 else b""
    if not tags.startswith(b",") or tags.strip(b"ifs") != b",":
        raise OscError(f"argument types must be ',' and letters i, f, s, got {tags[:32]!r}")
    try:
        return tuple(OscMessage(message))
    except (MessageError, ValueError) as error:
        raise OscError(f"invalid message: {error}") from error
