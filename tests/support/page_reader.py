"""Follow a page to the letter: type, edit, open terminals and end them."""

import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from installed_program import ERA
from patient_daemon import RESTING
from printed import difference
from typed_page import Edited, Interrupted, PageError, Seen, Step, Typed, Written

_PROGRESS = re.compile(r"^\d+ of \d+ [a-z ]+\n", re.MULTILINE)
"""Lines that appear where a command takes long; how many depends on the machine."""

PATIENCE = 300.0  # s; for one command, on a machine that is busy with other things
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
        here = {}
        for port, kind in PORTS.items():
            free = held.enter_context(socket.socket(socket.AF_INET, kind))
            free.bind(("127.0.0.1", 0))
            here[port] = str(free.getsockname()[1])
        return here


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
        step = self._here(step)
        match step:
            case Written():
                (self._folder / step.name).write_text(step.text, encoding="utf-8")
            case Edited():
                self._edit(step)
            case Interrupted():
                self._interrupt(step)
            case Typed(terminal=None):
                self._type(step)
            case Typed():
                self._begin(step)
            case Seen():
                self._wait_for(step.line, step.terminal, f"...\n{step.shown}")

    def _here(self, step: Step) -> Step:
        told: dict[str, Any] = {k: self._swapped(v) for k, v in asdict(step).items()}
        return replace(step, **told)

    def _swapped(self, told: object) -> object:
        if isinstance(told, str):
            for theirs, ours in self._swaps.items():
                told = re.sub(rf"(?<![\w.]){theirs}(?!\w)", ours, told)
        return told

    def _edit(self, step: Edited) -> None:
        path = self._folder / step.name
        text = path.read_text(encoding="utf-8")
        if text.count(step.old) != 1:
            raise PageError(f"line {step.line}: {text.count(step.old)} times in {step.name}")
        path.write_text(text.replace(step.old, step.new), encoding="utf-8")

    def _type(self, step: Typed) -> None:
        printed, status = "", 0
        for words in _commands(step.commands):
            done = subprocess.run(
                words,
                cwd=self._folder,
                env=self._environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=PATIENCE,
                check=False,
            )
            printed, status = printed + _PROGRESS.sub("", done.stdout), done.returncode
            if status:
                break
        if status != step.status:
            raise PageError(f"line {step.line}: exit status {status}\n{printed}")
        _compare(step.line, step.shown, printed)

    def _begin(self, step: Typed) -> None:
        assert step.terminal is not None
        output = self._folder.parent / f"{step.terminal}.txt"
        commands = _commands(step.commands)
        with output.open("wb") as file:
            process = subprocess.Popen(
                commands[0] if len(commands) == 1 else ["bash", "-e", "-c", step.commands],
                cwd=self._folder,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._terminals[step.terminal] = process, output
        self._wait_for(step.line, step.terminal, step.shown or "")

    def _wait_for(self, line: int, terminal: str, shown: str) -> None:
        process, output = self._terminals[terminal]
        latest = time.monotonic() + PATIENCE
        while True:
            ended = process.poll() is not None or time.monotonic() > latest
            printed = output.read_text(encoding="utf-8")
            wanted = self._with_its_terminal(shown.rstrip("\n") + "\n...", printed)
            if difference(wanted, printed) is None:
                return
            if ended:  # and whatever it has printed until then has been read since
                _compare(line, wanted, printed)
            time.sleep(LOOK_AGAIN)

    def _with_its_terminal(self, shown: str, printed: str) -> str:
        """What is shown, with the pseudo-terminal that a program has got, from here on known."""
        theirs, ours = _TERMINAL.search(shown), _TERMINAL.search(printed)
        if theirs is None or ours is None:
            return shown
        if theirs[0] not in self._swaps:
            # While it is held open, the system does not reuse its name.
            self._held.append(os.open(ours[0], os.O_RDWR | os.O_NOCTTY))
        self._swaps[theirs[0]] = ours[0]
        return shown.replace(theirs[0], ours[0])

    def _interrupt(self, step: Interrupted) -> None:
        process, output = self._terminals[step.terminal]
        os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(PATIENCE)
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


def _compare(line: int, shown: str | None, printed: str) -> None:
    if shown is not None and (what := difference(shown, printed)) is not None:
        raise PageError(f"line {line}: {what}\n\n{printed}")
