"""The last line of a command that wrote files."""

import os
import shlex
from pathlib import Path


def next_line(*words: str | Path) -> str:
    """Format the next command for the shell, with quotes where they are needed."""
    arguments = [str(word) for word in words]
    if os.name == "nt":
        from subprocess import list2cmdline

        return f"Next: {list2cmdline(arguments)}"
    return f"Next: {shlex.join(arguments)}"
