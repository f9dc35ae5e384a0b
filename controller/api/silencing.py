"""Lenient parsing of requests that silence the plate: `stop` and `disarm`.

A newer client must be able to stop an older daemon, and so must a client with a bug. A request that
silences is therefore identified only by the name of the method, and is carried out in spite of any
other error; the error is reported afterwards.
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import NamedTuple

from controller.api.jsonrpc import parse_json
from controller.api.methods import METHODS
from controller.api.schema import ApiMessage

_PRECEDENCE = ("stop", "disarm")  # if a line names both methods
_MARKS = (b"stop", b"disarm", b"\\u")  # every line that silences contains one
_NAMED = re.compile(rb'"method"\s*:\s*"(%s)"' % "|".join(_PRECEDENCE).encode())


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


def _search(text: bytes) -> SilencingRequest | None:
    """Search text for a method that silences; its parameters cannot be read."""
    methods = _NAMED.findall(text)
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
