"""What every format of content is, and the bounds of a file of any."""

from abc import ABC, abstractmethod
from typing import ClassVar

from controller.content.pattern import MAX_DURATION, Pattern
from model.config.document import ConfigError, ConfigProblem

MAX_SIZE = 4 << 20
"""Largest file [bytes]."""

MAX_POINTS = 20_000
"""Most points of a file: breakpoints, keyframes, events, or what one of them is made of."""


def refusal(source: str, message: str, *, line: int | None = None, key: str = "") -> ConfigError:
    """Return the error of a file as a whole, or of a key on a line."""
    return ConfigError(source, [ConfigProblem(line, key, message)])


def too_much(end: float, count: int) -> str:
    """Return what is wrong with content that ends at a time [s] and has so many points, or ""."""
    if end > MAX_DURATION:
        return f"must end within {MAX_DURATION:g} s, got {end:g} s; shorten it"
    return f"has more than {MAX_POINTS} points; leave some out" if count > MAX_POINTS else ""


class ContentFormat(ABC):
    """A format of content; a class for each, named by the ending of its files."""

    ending: ClassVar[str]
    """What a file's name ends with after the dot, in lower case."""

    has_channels: ClassVar[bool] = False
    """Whether a file may hold several channels, of which one is read."""

    @abstractmethod
    def read(self, content: bytes, source: str, channel: int) -> Pattern:
        """Return what a file asks for.

        content: all bytes of the file; source: its name, for errors; channel: counted from 1.
        Raises InputError for what the format does not allow, with the line and key where it has
        any. Nothing may be executed, or read from elsewhere, that a file names.
        """
