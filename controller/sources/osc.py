"""Open Sound Control messages from untrusted datagrams: bundles, texts and numbers of any type.

See the Open Sound Control 1.0 Specification (opensoundcontrol.stanford.edu/spec-1_0.html).
"""

import re
import struct
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


def osc_messages(datagram: bytes, *, limit: int) -> list[bytes]:
    """Return the encoded messages of a datagram in order, for `read_message`; so many at most.

    What is neither a message nor a bundle is among them; what follows an element whose size exceeds
    its bundle is one such element.
    """
    found, ends = list[bytes](), list[int]()  # of the bundles that enclose an element
    at, end, is_whole = 0, len(datagram), True
    while len(found) < limit:
        is_bundle = end - at >= _BUNDLE_HEADER and datagram.startswith(_BUNDLE, at)
        if is_whole and is_bundle and len(ends) < _MAX_DEPTH:
            ends.append(end)
            at += _BUNDLE_HEADER
        else:
            found.append(datagram[at:end])
            at = end
        while ends and at == ends[-1]:
            ends.pop()
        if not ends:
            break
        size = int.from_bytes(datagram[at : at + 4], "big", signed=True)
        is_whole = 0 < size <= ends[-1] - at - 4
        at, end = (at + 4, at + 4 + size) if is_whole else (at, ends[-1])
    return found


# Most messages of a panel repeat: its name, the contacts that are alive, resting fingers.
@lru_cache(maxsize=256)
def read_message(message: bytes) -> tuple[str, tuple[Argument, ...]]:
    """Return the address and the arguments of an encoded message; raises OscError.

    Bytes of a text that are not UTF-8 are written as \\xNN.
    """
    address = message.partition(b"\0")[0]
    at = len(address) // 4 * 4 + 4  # texts are padded by one to four zeros
    tags = message[at:].partition(b"\0")[0]
    runs = _RUNS.findall(tags)
    if not (_ADDRESS.fullmatch(address) and tags.startswith(b",")):
        raise OscError(f"element must be a message with argument types, got {message[:24]!r}")
    if b"".join(runs) != tags.translate(None, b",[]"):
        raise OscError(f"argument types must be letters of OSC 1.0, got {tags[:32]!r}")
    arguments: list[Argument] = []
    at += len(tags) // 4 * 4 + 4
    try:
        for run in runs:  # numbers that follow each other at once
            if run in (b"s", b"S"):
                end = message.index(b"\0", at)
                arguments.append(message[at:end].decode(errors="backslashreplace"))
                at += (end - at) // 4 * 4 + 4
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
