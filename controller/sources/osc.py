"""Open Sound Control messages from untrusted datagrams: flat bundles, texts and numbers.

See the Open Sound Control 1.0 Specification (opensoundcontrol.stanford.edu/spec-1_0.html).
"""

import re
import struct
from functools import lru_cache

_BUNDLE = b"#bundle\0"
_BUNDLE_HEADER = len(_BUNDLE) + 8  # the time tag is ignored: touches are current
_RUNS = re.compile(rb"s|[if]+")


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
    return raw.ljust(_padded_length(len(raw)), b"\0")


def _padded_length(length: int) -> int:
    """The bytes of a string with so many before its zeros."""
    return length + 4 - length % 4


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
    arguments: list[str | int | float] = []
    at = offset + _padded_length(len(tags))
    try:
        for run in _RUNS.findall(tags):  # numbers that follow each other at once
            if run == b"s":
                end = message.index(b"\0", at)
                arguments.append(message[at:end].decode())
                at += _padded_length(end - at)
            else:
                arguments += struct.unpack_from(b">" + run, message, at)
                at += 4 * len(run)
    except (struct.error, ValueError) as error:
        raise OscError(f"invalid message: {error}") from error
    if at > len(message):
        raise OscError("message must have all zeros after its last text")
    return tuple(arguments)
