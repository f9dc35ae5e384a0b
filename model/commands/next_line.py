"""The line that a run which wrote files ends with."""

import os
import shlex
from pathlib import Path


def next_line(*words: str | Path) -> str:
    """A command to go on with, as a shell takes it: names with spaces stand in quotes."""
    said = [str(word) for word in words]
    if os.name == "nt":
        from subprocess import list2cmdline

        return f"Next: {list2cmdline(said)}"
    return f"Next: {shlex.join(said)}"
