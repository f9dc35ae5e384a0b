"""Lenient parsing of requests that silence the plate: `stop` and `disarm`.

A newer client must be able to stop an older daemon, and so must a client with a bug. A request that
silences is therefore identified only by the name of the method, and is carried out in spite of any
other error; the error is reported afterwards.
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import NamedTuple

from controller.api.jsonrpc import parse_json
from controller.api.methods import METHODS
from controller.api.schema import ApiMessage

_PRECEDENCE = ("stop", "disarm")  # if a line names both methods
_MARKS = (b"stop", b"disarm", b"\\u")  # every line that silences contains one
_MARK = re.compile(b"|".join(map(re.escape, _MARKS)))
_MAX_CANDIDATES = 64  # lines that are parsed at once, so that the event loop never waits for long
_NAMED = re.compile(rb'"method"\s*:\s*"(%s)"' % "|".join(_PRECEDENCE).encode())
_ESCAPED_LETTER = re.compile(rb"\\u00([67][0-9a-fA-F])")


class SilencingRequest(NamedTuple):
    """A method that silences, with its readable parameters."""

    method: str
    params: ApiMessage


def read_silencing(line: bytes) -> SilencingRequest | None:
    """Identify a request that silences; None if the line names no such method. Never fails.

    Reads the method key of the request, or of each request of a batch. A line that is not JSON,
    repeats a key or exceeds a bound is searched as text, at any depth.
    """
    if not any(mark in line for mark in _MARKS):
        return None
    try:
        document = parse_json(line)
    except Exception:  # including bugs: the text decides
        return _search(line)
    batch = document if isinstance(document, list) else [document]
    requests = [request for request in batch if isinstance(request, dict)]
    for method in _PRECEDENCE:
        for request in requests:
            if request.get("method") == method:
                return SilencingRequest(method, readable_params(method, request.get("params")))
    return None


def find_silencing_line(lines: bytes) -> bytes | None:
    """Return the line that silences most; None if no line silences. Never fails.

    This is the first stop, else the last disarm without a lease, else the last disarm. Behind many
    lines that may silence, the remaining text counts as one line.
    """
    last_disarm: bytes | None = None
    is_restricted = True  # whether the last disarm applies to one lease only
    for line in _candidates(lines):
        request = read_silencing(line)
        if request is None:
            continue
        if request.method == "stop":
            return line
        has_lease = getattr(request.params, "lease", None) is not None
        if is_restricted or not has_lease:
            last_disarm = line
            is_restricted = has_lease
    return last_disarm


def _candidates(lines: bytes) -> Iterator[bytes]:
    """Yield the lines that may silence; after many, yield the remaining text as one line."""
    position = 0
    for _ in range(_MAX_CANDIDATES):
        mark = _MARK.search(lines, position)
        if mark is None:
            return
        start = lines.rfind(b"\n", 0, mark.start()) + 1
        end = lines.find(b"\n", mark.end())
        position = end if end >= 0 else len(lines)
        yield lines[start:position]
    yield lines[position:]


def _search(text: bytes) -> SilencingRequest | None:
    """Search text for a method that silences; its parameters cannot be read."""
    unescaped = _ESCAPED_LETTER.sub(lambda match: bytes.fromhex(match[1].decode()), text)
    methods = _NAMED.findall(unescaped)
    for method in _PRECEDENCE:
        if method.encode() in methods:
            return SilencingRequest(method, readable_params(method, {}))
    return None


def readable_params(method: str, content: object) -> ApiMessage:
    """Return the parameters of a method that silences, with defaults for invalid ones."""
    model = METHODS[method].params
    params = {}
    if isinstance(content, Mapping):
        for name in model.model_fields.keys() & content.keys():
            with suppress(Exception):  # any error: use the default
                params[name] = getattr(model(**{name: content[name]}), name)
    return model(**params)
