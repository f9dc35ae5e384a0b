"""A page of the docs as what its reader does, one step after the other.

A fence of `sh` is typed; a fence of `text` right below it is what that prints. Comments, which no
reader sees, say of the next fence:

    <!-- terminal: NAME -->    typed in a terminal of its own, where it goes on
    <!-- seen in: NAME -->     a `text`: what that terminal prints by and by, on lines of their own
    <!-- interrupt: NAME -->   Ctrl-C there, now
    <!-- status: N -->         ends with this exit status; 0 where nothing is said
    <!-- file: NAME -->        is written as this file
    <!-- edit: NAME -->        a `diff`: its lines of - are replaced by those of +
    <!-- not typed: WHY -->    is for another machine

Whatever else stands on the page is for reading.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

_COMMENT = re.compile(r"<!-- ([a-z ]+): (.+) -->")
_OF_A_FENCE = {"terminal", "seen in", "status", "file", "edit", "not typed"}


class PageError(ValueError):
    """A page that its reader could not follow either."""


@dataclass(frozen=True)
class Typed:
    """Commands, where they are typed, and what they print (None: the page does not say)."""

    line: int
    commands: str
    terminal: str | None
    status: int
    shown: str | None


@dataclass(frozen=True)
class Seen:
    """What a terminal goes on to print."""

    line: int
    terminal: str
    shown: str


@dataclass(frozen=True)
class Interrupted:
    """Ctrl-C in a terminal, after which that program ends."""

    line: int
    terminal: str


@dataclass(frozen=True)
class Written:
    """A file as a whole."""

    line: int
    name: str
    text: str


@dataclass(frozen=True)
class Edited:
    """Lines of a file, replaced by others."""

    line: int
    name: str
    old: str
    new: str


Step = Typed | Seen | Interrupted | Written | Edited


def read_steps(page: Path) -> list[Step]:
    """What a reader does, in order; raises PageError for a fence or comment without a meaning."""
    steps: list[Step] = []
    said: dict[str, str] = {}
    may_print = False  # a fence of text would be what the last step prints
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        line = token.map[0] + 1 if token.map else 0
        where = f"{page.name}:{line}"
        if token.type == "inline":
            may_print = False
        elif token.type == "html_block":
            for key, value in _COMMENT.findall(token.content):
                if key == "interrupt":
                    steps.append(Interrupted(line, value))
                elif key in _OF_A_FENCE:
                    said[key] = value
                else:
                    raise PageError(f"{where}: no comment is called {key!r}")
        elif token.type == "fence":
            kind = token.info.strip()
            if kind == "text" and may_print and "seen in" not in said:
                steps[-1] = _with_output(steps[-1], token.content, where=where)
                may_print = False
            elif "not typed" not in said:
                step = _step(kind, token.content, said, line=line)
                if step is None and said:
                    raise PageError(f"{where}: a fence of {kind!r} cannot be {said}")
                steps += [] if step is None else [step]
                may_print = step is not None
            said = {}
    return steps


def _step(kind: str, text: str, said: dict[str, str], *, line: int) -> Step | None:
    if kind == "sh":
        return Typed(line, text, said.get("terminal"), int(said.get("status", "0")), None)
    if kind == "text" and "seen in" in said:
        return Seen(line, said["seen in"], text)
    if "file" in said:
        return Written(line, said["file"], text)
    if kind == "diff" and "edit" in said:
        lines = text.splitlines(keepends=True)
        old = "".join(each[1:] for each in lines if not each.startswith("+"))
        new = "".join(each[1:] for each in lines if not each.startswith("-"))
        return Edited(line, said["edit"], old, new)
    return None


def _with_output(step: Step, shown: str, *, where: str) -> Step:
    match step:
        case Typed(line, commands, terminal, status, None):
            return Typed(line, commands, terminal, status, shown)
        case _:
            raise PageError(f"{where}: nothing is typed above this output")
