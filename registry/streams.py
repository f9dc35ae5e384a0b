"""Standard streams that escape control characters, and that exist even if they are closed.

Output can quote file names, replies of amplifiers and text from other clients. Control characters
in quoted text could clear a terminal, rename its window or hide a line.
"""

import io
import os
import re
import sys
from pathlib import Path
from typing import TextIO

# Control characters except line feed and tab, and marks that change the direction of text.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """Escape control characters except line feed and tab, for example as `\\x1b`."""
    return _CONTROL.sub(lambda match: ascii(match[0])[1:-1], text)


class PrintableStream(io.TextIOWrapper):
    """Text stream that escapes control characters."""

    def write(self, text: str) -> int:
        """Write text; return the length of the original text."""
        super().write(printable(text))
        return len(text)


def protect_streams() -> None:
    """Escape control characters on standard output and error; open closed streams as /dev/null.

    A service or a program with windows can start with closed streams. Characters that the encoding
    of a stream lacks are escaped, too.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets this number, which no other file must get
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open(mode, encoding="utf-8")  # noqa: SIM115
            setattr(sys, name, stream)
    sys.stdout = _protected(sys.stdout)
    sys.stderr = _protected(sys.stderr)


def _protected(stream: TextIO) -> TextIO:
    if type(stream) is not io.TextIOWrapper:  # protected already, or replaced to capture the output
        return stream
    encoding, is_by_line = stream.encoding, stream.line_buffering
    return PrintableStream(stream.detach(), encoding, "backslashreplace", line_buffering=is_by_line)


def drawing_on(stream: TextIO) -> TextIO:
    """Return a stream to the same file without escaping, for libraries that draw on a terminal."""
    if not isinstance(stream, PrintableStream):
        return stream
    stream.flush()
    return open(stream.fileno(), "w", encoding=stream.encoding, errors=stream.errors, closefd=False)
