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

Whatever else stands on the page is for reading. The reader types, edits, and opens and ends
terminals in an empty folder, where nothing of a checkout can be found, with an installed `era`; an
error says which command did what else.

A command must print the facts that the page shows; the words around them are free. Facts are
numbers and what holds a digit, an underscore, a slash, a dot within, or two capitals: names of
states, files and addresses. `...` stands for any of them within a line, and on a line of its own
for any lines. A number may be off by one in its last printed digit, or by two parts in a hundred,
whichever is more. Lines without facts are not compared.
"""

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt

from processes.installed import ERA
from processes.patient_daemon import RESTING

_COMMENT = re.compile(r"<!-- ([a-z ]+): (.+) -->")
_OF_A_FENCE = {"terminal", "seen in", "status", "file", "edit", "not typed"}


class PageError(ValueError):
    """A page that its reader could not follow either."""


@dataclass(frozen=True)
class Step:
    """What a reader does, by the line of the page.

    kind: `typed` commands, with their exit status; `seen`, what a terminal goes on to print;
    `interrupted`, Ctrl-C in a terminal; a file that is `written` as a whole or `edited`. name: of
    the terminal or file; text: as it is on the page; shown: what commands print, None where the
    page does not say.
    """

    line: int
    kind: str
    text: str = ""
    name: str = ""
    status: int = 0
    shown: str | None = None


def read_steps(page: Path) -> list[Step]:
    """What a reader does, in order; raises PageError for a fence or comment without a meaning."""
    steps: list[Step] = []
    comments: dict[str, str] = {}
    may_print = False  # a fence of text would be what the last step prints
    for token in MarkdownIt().parse(page.read_text(encoding="utf-8")):
        line = token.map[0] + 1 if token.map else 0
        where = f"{page.name}:{line}"
        if token.type == "inline":
            may_print = False
        elif token.type == "html_block":
            for key, value in _COMMENT.findall(token.content):
                if key == "interrupt":
                    steps.append(Step(line, "interrupted", name=value))
                elif key in _OF_A_FENCE:
                    comments[key] = value
                elif key != "begin":  # of a part that is written from the code
                    raise PageError(f"{where}: no comment is called {key!r}")
        elif token.type == "fence":
            kind = token.info.strip()
            if kind == "text" and may_print and "seen in" not in comments:
                if steps[-1].kind != "typed" or steps[-1].shown is not None:
                    raise PageError(f"{where}: nothing is typed above this output")
                steps[-1] = replace(steps[-1], shown=token.content)
                may_print = False
            elif "not typed" not in comments:
                step = _step(kind, token.content, comments, line=line)
                if step is None and comments:
                    raise PageError(f"{where}: a fence of {kind!r} cannot be {comments}")
                steps += [] if step is None else [step]
                may_print = step is not None
            comments = {}
    return steps


def _step(kind: str, text: str, comments: dict[str, str], *, line: int) -> Step | None:
    if kind == "sh":
        status = int(comments.get("status", "0"))
        return Step(line, "typed", text, comments.get("terminal", ""), status)
    if kind == "text" and "seen in" in comments:
        return Step(line, "seen", text, comments["seen in"])
    if "file" in comments:
        return Step(line, "written", text, comments["file"])
    if kind == "diff" and "edit" in comments:
        return Step(line, "edited", text, comments["edit"])
    return None


_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_FACT = re.compile(r"\d|_|/|\w\.\w|[A-Z]{2}")
GAP = "..."
_WORDS = re.compile(r"ERAs?|JSON|YAML|SL")
_PUNCTUATION = ",;:()[]{}'\"`"
_SHARE = 0.02


def difference(expected: str, printed: str) -> str | None:
    """Return the first shown line whose facts are not printed where they should be, else None."""
    wanted = [_facts(line) for line in expected.splitlines()]
    lines = [facts for line in printed.splitlines() if (facts := _facts(line))]
    if not any(wanted):
        enough = len(printed.splitlines()) >= len(wanted)
        return None if enough else f"{len(wanted)} lines shown; printed: {printed!r}"
    reached = (0, 0)

    @cache
    def fits(number: int, at: int) -> bool:
        """Whether the shown lines from this one on are the printed ones from there on."""
        nonlocal reached
        reached = max(reached, (number, at))
        if number == len(wanted):
            return at == len(lines)
        if not wanted[number]:
            return fits(number + 1, at)
        if set(wanted[number]) == {GAP}:
            return any(fits(number + 1, later) for later in range(at, len(lines) + 1))
        return at < len(lines) and _match(wanted[number], lines[at]) and fits(number + 1, at + 1)

    if fits(0, 0):
        return None
    number, at = reached
    instead = " ".join(lines[at]) if at < len(lines) else "the end"
    if number == len(wanted):
        return f"printed beyond what is shown: {instead}"
    return f"line {number + 1} shown: {expected.splitlines()[number]!r}; printed there: {instead!r}"


def _match(wanted: Sequence[str], printed: Sequence[str]) -> bool:
    """Whether the facts of a printed line are those of the shown one."""
    if not wanted:
        return not printed
    first, *following = wanted
    if first == GAP:
        return any(_match(following, printed[at:]) for at in range(len(printed) + 1))
    return bool(printed) and _is_same(first, printed[0]) and _match(following, printed[1:])


def _is_same(wanted: str, printed: str) -> bool:
    if _NUMBER.fullmatch(wanted) and _NUMBER.fullmatch(printed):
        return _is_about(wanted, printed)
    return re.fullmatch(".*".join(map(re.escape, wanted.split(GAP))), printed) is not None


def _facts(line: str) -> list[str]:
    tokens = (token.strip(_PUNCTUATION) for token in line.split())
    cut = [token if token.endswith(GAP) else token.removesuffix(".") for token in tokens]
    marked = [GAP if GAP in token and not _is_fact(token) else token for token in cut]
    return [token for token in marked if token == GAP or _is_fact(token)]


def _is_fact(token: str) -> bool:
    words = token.replace(GAP, " ")
    return _FACT.search(words) is not None and not _WORDS.fullmatch(token)


def _is_about(wanted: str, printed: str) -> bool:
    mantissa, _, exponent = wanted.partition("e")
    last_digit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
    if "." not in wanted and not exponent:
        last_digit = 0.0 if abs(int(wanted)) < 10 else 1.0  # counts are counts
    allowed = max(1.001 * last_digit, _SHARE * abs(float(wanted)))
    return abs(float(wanted) - float(printed)) <= allowed


_PROGRESS = re.compile(r"^era: \d+ of \d+ [a-z ]+(, about \d+ (s|min) left)?\n", re.MULTILINE)
"""Lines that appear where a command takes long; how many depends on the machine."""

READER_PATIENCE = 300.0  # s; for one command, on a machine that is busy with other things
LOOK_AGAIN = 0.05  # s
PORTS = {
    "3333": socket.SOCK_DGRAM,
    "4444": socket.SOCK_DGRAM,
    "5020": socket.SOCK_STREAM,
    "7010": socket.SOCK_STREAM,
    "8137": socket.SOCK_STREAM,
    "8786": socket.SOCK_STREAM,
}
"""Those that pages name; a reader takes others, for on this machine they may be taken."""
_TERMINAL = re.compile(r"/dev/pts/\d+")


def free_ports() -> dict[str, str]:
    """Find a free port for every port that pages name."""
    with ExitStack() as held:
        numbers = {}
        for port, kind in PORTS.items():
            free = held.enter_context(socket.socket(socket.AF_INET, kind))
            free.bind(("127.0.0.1", 0))
            numbers[port] = str(free.getsockname()[1])
        return numbers


class Reader:
    """Does steps in a folder; leave the block to have every terminal closed.

    folder: where the files go. home: a short path for what programs keep, sockets among them.
    programs: a folder of those that come before all others. site: where Python finds what is
    installed. What a page names and what is another one here, ports and
    pseudo-terminals, is replaced in all that is typed, written and shown.
    """

    def __init__(
        self, folder: Path, *, home: Path, programs: Path | None = None, site: Path | None = None
    ) -> None:
        self._folder = folder
        self._swaps = free_ports()
        first = [str(programs)] if programs else []
        self._environment = {
            "HOME": str(home),
            "LANG": "C.UTF-8",
            "NO_COLOR": "1",
            "COLUMNS": "100",
            "PATH": ":".join([*first, str(Path(sys.executable).parent), os.environ["PATH"]]),
            "PYTHONUNBUFFERED": "1",
            # Of `make test-kernels`: what processor to compute as.
            **{
                name: value
                for name, value in os.environ.items()
                if name.startswith(("OPENBLAS_", "PYTHONPATH"))
            },
            "OPENBLAS_NUM_THREADS": "1",
            "TMPDIR": str(home),
            "XDG_CACHE_HOME": str(home / "cache"),
            "XDG_RUNTIME_DIR": str(home),
            **({"PYTHONPATH": str(site)} if site else {}),
        }
        self._held: list[int] = []
        self._terminals: dict[str, tuple[subprocess.Popen[bytes], Path]] = {}

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_: object) -> None:
        for process, _output in self._terminals.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        for line in self._held:
            os.close(line)

    def follow(self, step: Step) -> None:
        """Do one step; raises PageError where anything else comes of it than the page says."""
        values: dict[str, Any] = {key: self._swapped(value) for key, value in asdict(step).items()}
        step = replace(step, **values)
        match step.kind:
            case "written":
                (self._folder / step.name).write_text(step.text, encoding="utf-8")
            case "edited":
                self._edit(step)
            case "interrupted":
                self._interrupt(step)
            case "seen":
                self._wait_for(step.line, step.name, f"...\n{step.text}")
            case "typed" if step.name:
                self._begin(step)
            case _:
                self._type(step)

    def _swapped(self, value: object) -> object:
        if isinstance(value, str):
            for theirs, ours in self._swaps.items():
                value = re.sub(rf"(?<![\w.]){theirs}(?!\w)", ours, value)
        return value

    def _edit(self, step: Step) -> None:
        path = self._folder / step.name
        text, lines = path.read_text(encoding="utf-8"), step.text.splitlines(keepends=True)
        old = "".join(line[1:] for line in lines if not line.startswith("+"))
        new = "".join(line[1:] for line in lines if not line.startswith("-"))
        if text.count(old) != 1:
            raise PageError(f"line {step.line}: {text.count(old)} times in {step.name}")
        path.write_text(text.replace(old, new), encoding="utf-8")

    def _type(self, step: Step) -> None:
        printed, status = "", 0
        for words in _commands(step.text):
            done = subprocess.run(
                words,
                cwd=self._folder,
                env=self._environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=READER_PATIENCE,
                check=False,
            )
            printed, status = printed + _PROGRESS.sub("", done.stdout), done.returncode
            if status:
                break
        if status != step.status:
            raise PageError(f"line {step.line}: exit status {status}\n{printed}")
        _compare(step.line, step.shown, printed)

    def _begin(self, step: Step) -> None:
        output = self._folder.parent / f"{step.name}.txt"
        commands = _commands(step.text)
        with output.open("wb") as file:
            process = subprocess.Popen(
                commands[0] if len(commands) == 1 else ["bash", "-e", "-c", step.text],
                cwd=self._folder,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._terminals[step.name] = process, output
        self._wait_for(step.line, step.name, step.shown or "")

    def _wait_for(self, line: int, terminal: str, expected: str) -> None:
        process, output = self._terminals[terminal]
        latest = time.monotonic() + READER_PATIENCE
        # Lines without numbers or names match nothing at all, so the lines are counted too.
        shown_lines = [line for line in expected.splitlines() if line.strip() not in ("", GAP)]
        while True:
            ended = process.poll() is not None or time.monotonic() > latest
            printed = output.read_text(encoding="utf-8")
            wanted = self._with_its_terminal(expected.rstrip("\n") + "\n...", printed)
            is_complete = len(printed.splitlines()) >= len(shown_lines)
            if is_complete and difference(wanted, printed) is None:
                return
            if ended:  # everything printed until then has been read
                _compare(line, wanted, printed)
                raise PageError(f"line {line}: {len(shown_lines)} lines shown, printed:\n{printed}")
            time.sleep(LOOK_AGAIN)

    def _with_its_terminal(self, expected: str, printed: str) -> str:
        """What is shown, with the pseudo-terminal that a program has got, from here on known."""
        theirs, ours = _TERMINAL.search(expected), _TERMINAL.search(printed)
        if theirs is None or ours is None:
            return expected
        if theirs[0] not in self._swaps:
            # While it is held open, the system does not reuse its name.
            self._held.append(os.open(ours[0], os.O_RDWR | os.O_NOCTTY))
        self._swaps[theirs[0]] = ours[0]
        return expected.replace(theirs[0], ours[0])

    def _interrupt(self, step: Step) -> None:
        process, output = self._terminals[step.name]
        os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(READER_PATIENCE)
        except subprocess.TimeoutExpired:
            raise PageError(f"line {step.line}: goes on\n{output.read_text('utf-8')}") from None


def _commands(fence: str) -> list[list[str]]:
    """What runs a fence: each line by itself where all are plain commands, else a shell.

    A daemon waits for a busy machine, see `patient_daemon`.
    """
    plain = re.fullmatch(r"((era|pip|python|cp) [^|&;<>$`*?~#\\\n]+\n)+", fence)
    if plain is None:
        return [["bash", "-e", "-c", fence]]
    lines = [shlex.split(line) for line in fence.splitlines()]
    era = {"daemon": RESTING}
    return [
        [*era.get(words[1], (ERA,)), *words[1:]] if words[0] == "era" else words for words in lines
    ]


def _compare(line: int, expected: str | None, printed: str) -> None:
    if expected is not None and (problem := difference(expected, printed)) is not None:
        raise PageError(f"line {line}: {problem}\n\n{printed}")
