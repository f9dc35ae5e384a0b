"""Standard streams: foreign text never controls a terminal, and closed streams do no harm.

Output can quote names in files, replies of amplifiers or words of other clients. Control characters
in these could clear a terminal, rename its window or hide a line.
"""

import io
import os
import re
import sys
from pathlib import Path
from typing import TextIO

# Control characters but for line feed and tab, and marks that turn the direction of text.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Escape control characters but for line feed and tab, as `\\x1b`."""
    return _CONTROL.sub(lambda match: ascii(match[0])[1:-1], text)


class PrintableStream(io.TextIOWrapper):
    """A stream of text on which control characters are escaped."""

    def write(self, text: str) -> int:
        """Write text; return its length, as callers expect."""
        super().write(printable(text))
        return len(text)


def protect_streams() -> None:
    """Escape control characters on standard output and error, and open streams that are closed.

    A closed stream reads and writes nothing, as /dev/null: a service or a program with windows may
    start without them. Characters that an encoding lacks are escaped as well.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # has this number, which no other file may get
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115
            setattr(sys, name, stream)
    sys.stdout = _protected(sys.stdout)
    sys.stderr = _protected(sys.stderr)


def _protected(stream: TextIO) -> TextIO:
    if type(stream) is not io.TextIOWrapper:  # protected, or what captures the output
        return stream
    encoding, is_by_line = stream.encoding, stream.line_buffering
    return PrintableStream(stream.detach(), encoding, "backslashreplace", line_buffering=is_by_line)


def drawing_on(stream: TextIO) -> TextIO:
    """Return a stream to the same file without escapes, for libraries that draw on a terminal."""
    if not isinstance(stream, PrintableStream):
        return stream
    stream.flush()
    return open(stream.fileno(), "w", encoding=stream.encoding, errors=stream.errors, closefd=False)
