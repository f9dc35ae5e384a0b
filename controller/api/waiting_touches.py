"""Touch frames that wait to be delivered: the newest counts, but no finger that came is lost."""

from collections.abc import Sequence
from typing import Any, Protocol, TypeVar

MAX_WAITING = 8  # frames of one source; more are no taps of a person


class _Frame(Protocol):
    @property
    def touches(self) -> Sequence[Any]: ...  # each with an id


Frame = TypeVar("Frame", bound=_Frame)


def supersedes(newer: _Frame, older: _Frame) -> bool:
    """Whether a frame has all fingers of an older one of its source, which then does not count."""
    return {each.id for each in older.touches} <= {each.id for each in newer.touches}


def add_frame(waiting: list[Frame], frame: Frame) -> None:
    """Add a frame to those of its source, in place of the last one where that does not count."""
    if waiting and (supersedes(frame, waiting[-1]) or len(waiting) >= MAX_WAITING):
        waiting.pop()
    waiting.append(frame)
