"""Which lines that wait are made moot by the next one: touches, of which the newest counts.

A client that floods sends more than anybody needs. To see that one is moot costs a fraction of
doing what it says, so the newest is not far behind even then, and others wait less.
"""

from functools import lru_cache

from pydantic_core import from_json


def is_moot(line: bytes, following: bytes) -> bool:
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
        case {"method": "touch", "params": {"source": str(source), "touches": list()}}:
            return None if "id" in said else source
    return None
