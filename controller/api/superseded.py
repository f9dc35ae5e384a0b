"""Which lines that wait are made moot by the next one: touches, of which the newest counts.

A client that floods sends more than anybody needs. To see that one is moot costs a fraction of
doing what it says, so the newest is not far behind even then, and others wait less.

A frame holds all fingers of its source, so that with the newest nothing is left down that was
lifted; who lifted and touched again within the time that lines wait has moved. What would be
refused takes no other's place, or a lift could get lost.
"""

from contextlib import suppress
from functools import lru_cache

from pydantic_core import ValidationError, from_json

from controller.api.methods import TouchParams


def is_superseded(line: bytes, following: bytes) -> bool:
    """Whether a line is a touch that wants no answer, and the following one takes its place."""
    source = _source(line)
    return source is not None and source == _source(following)


@lru_cache(maxsize=2)  # what followed is asked about again, as the line that it is then
def _source(line: bytes) -> str | None:
    """The source of a touch that wants no answer; None of any other line."""
    try:
        said = from_json(line, allow_inf_nan=False)
    except ValueError:
        return None
    match said:
        # Nothing else is in it, least of all an id.
        case {"jsonrpc": "2.0", "method": "touch", "params": params} if len(said) == 3:
            with suppress(ValidationError):
                return TouchParams.model_validate(params).source
    return None
