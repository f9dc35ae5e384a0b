"""Open Sound Control 1.0 (opensoundcontrol.stanford.edu/spec-1_0.html) in untrusted datagrams."""

import re
import struct
from functools import lru_cache
from typing import TypeAlias

from model.errors import InputError

Argument: TypeAlias = str | int | float | None
"""Argument of a message; None for a blob, true, false, nil and impulse."""

_BUNDLE = b"#bundle\0"
_BUNDLE_HEADER = len(_BUNDLE) + 8  # bytes; the time tag is ignored: touches are current
_MAX_DEPTH = 8  # of nested bundles
_ADDRESS = re.compile(rb"/[!-~]*")
_RUNS = re.compile(rb"[sS]|b|[TFNI]+|[ifdhtcrm]+")
_CODES = bytes.maketrans(b"htcrm", b"qQiII")  # codes of `struct`, which already has i, f and d


def osc_messages(datagram: bytes, *, limit: int) -> list[bytes]:
    """Return the encoded messages of a datagram in order, for `read_message`; up to a limit.

    Elements that are neither message nor bundle are included; after an element whose size exceeds
    its bundle, the remainder is one such element.
    """
    messages: list[bytes] = []
    bundle_ends: list[int] = []  # of the bundles around an element
    start = 0
    end = len(datagram)
    is_complete = True
    while len(messages) < limit:
        is_bundle = end - start >= _BUNDLE_HEADER and datagram.startswith(_BUNDLE, start)
        if is_complete and is_bundle and len(bundle_ends) < _MAX_DEPTH:
            bundle_ends.append(end)
            start += _BUNDLE_HEADER
        else:
            messages.append(datagram[start:end])
            start = end
        while bundle_ends and start == bundle_ends[-1]:
            bundle_ends.pop()
        if not bundle_ends:
            break
        size = int.from_bytes(datagram[start : start + 4], "big", signed=True)
        end = bundle_ends[-1]
        is_complete = 0 < size <= end - start - 4
        if is_complete:
            start += 4
            end = start + size
    return messages


# Most messages of a panel repeat: its name, active contacts, resting fingers.
@lru_cache(maxsize=256)
def read_message(message: bytes) -> tuple[str, tuple[Argument, ...]]:
    """Return the address and the arguments of an encoded message; raises InputError.

    Bytes of a text that are not valid UTF-8 are written as \\xNN.
    """
    address = message.partition(b"\0")[0]
    position = _padded_size(address)
    tags = message[position:].partition(b"\0")[0]
    runs = _RUNS.findall(tags)
    if not (_ADDRESS.fullmatch(address) and tags.startswith(b",")):
        raise InputError(f"element must be a message with argument types, got {message[:24]!r}")
    if b"".join(runs) != tags.translate(None, b",[]"):
        raise InputError(f"argument types must be letters of OSC 1.0, got {tags[:32]!r}")
    arguments: list[Argument] = []
    position += _padded_size(tags)
    try:
        for run in runs:  # consecutive numbers in one step
            if run in (b"s", b"S"):
                text = message[position : message.index(b"\0", position)]
                arguments.append(text.decode(errors="backslashreplace"))
                position += _padded_size(text)
            elif run == b"b":
                (size,) = struct.unpack_from(">I", message, position)
                arguments.append(None)
                position += 4 + (size + 3) // 4 * 4
            elif run[0] in b"TFNI":
                arguments += [None] * len(run)
            else:
                layout = ">" + run.translate(_CODES).decode()
                arguments += struct.unpack_from(layout, message, position)
                position += struct.calcsize(layout)
    except (struct.error, ValueError) as error:
        raise InputError(f"invalid message: {error}") from error
    return address.decode(), tuple(arguments)


def _padded_size(text: bytes) -> int:
    """Return the size of an encoded string, which is padded with one to four zeros."""
    return len(text) // 4 * 4 + 4
