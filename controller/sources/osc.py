"""Open Sound Control messages from untrusted datagrams: bundles, texts and numbers of any type.

See the Open Sound Control 1.0 Specification (opensoundcontrol.stanford.edu/spec-1_0.html).
"""

import re
import struct
from collections.abc import Iterator
from functools import lru_cache
from typing import TypeAlias

Argument: TypeAlias = str | int | float | None
"""Argument of a message; None for a blob, and for true, false, nil and impulse."""

_BUNDLE = b"#bundle\0"
_BUNDLE_HEADER = len(_BUNDLE) + 8  # the time tag is ignored: touches are current
_MAX_DEPTH = 8  # of bundles in bundles
_ADDRESS = re.compile(rb"/[!-~]*")
_RUNS = re.compile(rb"[sS]|b|[TFNI]+|[ifdhtcrm]+")
_CODES = bytes.maketrans(b"htcrm", b"qQiII")  # of struct, which has those of i, f and d


class OscError(ValueError):
    """A message that cannot be read."""


def osc_messages(datagram: bytes, *, depth: int = _MAX_DEPTH) -> Iterator[bytes]:
    """Yield the encoded messages of a datagram in order, for `read_message`.

    What is neither a message nor a bundle is yielded, too; what follows an element whose size
    exceeds its bundle is one such element. depth: how many bundles may enclose a message.
    """
    if len(datagram) < _BUNDLE_HEADER or not datagram.startswith(_BUNDLE) or not depth:
        yield datagram
        return
    offset = _BUNDLE_HEADER
    while offset < len(datagram):
        size = int.from_bytes(datagram[offset : offset + 4], "big", signed=True)
        if not 0 < size <= len(datagram) - offset - 4:
            yield datagram[offset:]
            return
        yield from osc_messages(datagram[offset + 4 : offset + 4 + size], depth=depth - 1)
        offset += 4 + size


def _padded_length(length: int) -> int:
    """The bytes of a string with so many before its zeros."""
    return length + 4 - length % 4


# Most messages of a panel repeat: its name, the contacts that are alive, resting fingers.
@lru_cache(maxsize=256)
def read_message(message: bytes) -> tuple[str, tuple[Argument, ...]]:
    """Return the address and the arguments of an encoded message; raises OscError.

    Bytes of a text that are not UTF-8 are written as \\xNN.
    """
    address = message.partition(b"\0")[0]
    at = _padded_length(len(address))
    tags = message[at:].partition(b"\0")[0]
    runs = _RUNS.findall(tags)
    if not (_ADDRESS.fullmatch(address) and tags.startswith(b",")):
        raise OscError(f"element must be a message with argument types, got {message[:24]!r}")
    if b"".join(runs) != tags.translate(None, b",[]"):
        raise OscError(f"argument types must be letters of OSC 1.0, got {tags[:32]!r}")
    arguments: list[Argument] = []
    at += _padded_length(len(tags))
    try:
        for run in runs:  # numbers that follow each other at once
            if run in (b"s", b"S"):
                end = message.index(b"\0", at)
                arguments.append(message[at:end].decode(errors="backslashreplace"))
                at += _padded_length(end - at)
            elif run == b"b":
                (size,) = struct.unpack_from(">I", message, at)
                arguments.append(None)
                at += 4 + (size + 3) // 4 * 4
            elif run[0] in b"TFNI":
                arguments += [None] * len(run)
            else:
                layout = ">" + run.translate(_CODES).decode()
                arguments += struct.unpack_from(layout, message, at)
                at += struct.calcsize(layout)
    except (struct.error, ValueError) as error:
        raise OscError(f"invalid message: {error}") from error
    return address.decode(), tuple(arguments)
