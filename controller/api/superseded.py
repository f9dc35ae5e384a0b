"""Whether a queued line is superseded by the next one: of touch frames only the newest counts.

Recognising this costs a fraction of serving the line, so a client that floods the daemon with
touches neither lags behind nor delays others. A frame holds all fingers of its source, hence no
lift is lost. A line that would be refused supersedes nothing.
"""

from contextlib import suppress
from functools import lru_cache

from pydantic_core import ValidationError, from_json

from controller.api.methods import TouchParams


def is_superseded(line: bytes, following: bytes) -> bool:
    """Whether both lines are touch frames of one source, without an id."""
    source = _touch_source(line)
    return source is not None and source == _touch_source(following)


@lru_cache(maxsize=2)  # the following line is the first one next time
def _touch_source(line: bytes) -> str | None:
    """The source of a valid touch frame without an id; None for any other line."""
    try:
        content = from_json(line, allow_inf_nan=False)
    except ValueError:
        return None
    match content:
        case {"jsonrpc": "2.0", "method": "touch", "params": params} if len(content) == 3:
            with suppress(ValidationError):
                return TouchParams.model_validate(params).source
    return None
