"""The commands of a page, typed one after the other in one terminal, and what it shows then.

A page shows them in blocks of `console`, each after a `$`, with what is printed below; `...` stands
for whatever is there. `&` leaves one running, and `kill %1` ends it. Where a page installs an
example, it is installed already, and uninstalling takes it from the path.
"""

import doctest
import os
import re
import shlex
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

PATIENCE = 60.0  # s; on a machine that is busy with other things
_BLOCK = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_TERMINAL = re.compile(r"/dev/pts/\d+")
_SAME = doctest.OutputChecker()


@dataclass(frozen=True)
class Step:
    """A command and what is seen below it."""

    command: str
    shown: str


def steps_of(page: Path) -> list[Step]:
    """All of a page, in order."""
    steps = []
    for block in _BLOCK.findall(page.read_text("utf-8")):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, shown = part.partition("\n")
            steps.append(Step(command, shown))
    return steps


class Terminal:
    """Where commands are typed: a folder, in which `installed` is on Python's path.

    swaps: what of a page stands for something else here, as its ports.
    """

    def __init__(self, folder: Path, *, installed: Path, swaps: dict[str, str]) -> None:
        self._folder = folder
        self._swaps = dict(swaps)
        self._log = (folder / "terminal.log").open("w+", encoding="utf-8")
        self._seen = 0
        self._running: list[subprocess.Popen[str]] = []
        bin_folder = str(Path(sys.executable).parent)
        self._environment = os.environ | {
            "PATH": os.pathsep.join([bin_folder, os.environ["PATH"]]),
            "PYTHONPATH": str(installed),
            "PYTHONUNBUFFERED": "1",
            "COLUMNS": "80",
            "XDG_CACHE_HOME": str(folder / "cache"),
        }

    def __enter__(self) -> "Terminal":
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        self._log.close()

    def type(self, step: Step) -> None:
        """Type a command and see what the page shows; AssertionError for anything else."""
        words = shlex.split(step.command)
        if words[:2] == ["pip", "install"]:
            told = tomllib.loads((self._folder / words[2] / "pyproject.toml").read_text("utf-8"))
            package = f"{told['project']['name']}-{told['project']['version']}"
            assert step.shown.endswith(f"Successfully installed {package}\n"), step.command
        elif words[:2] == ["pip", "uninstall"]:
            del self._environment["PYTHONPATH"]
        elif words[0] == "kill":
            self._end()
        else:
            self._run(words)
            self._expect(step)

    def _run(self, words: list[str]) -> None:
        goes_on = words[-1] == "&"
        process = subprocess.Popen(
            [self._here(word) for word in (words[:-1] if goes_on else words)],
            cwd=self._folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._running.append(process)
        if not goes_on:
            process.wait(PATIENCE)
            self._running.remove(process)

    def _expect(self, step: Step) -> None:
        wanted = self._here(step.shown)
        end = time.monotonic() + PATIENCE
        while True:
            self._log.seek(0)
            found = self._log.read()[self._seen :]
            if (terminal := _TERMINAL.search(found)) and "/dev/pts/5" in wanted:
                self._swaps["/dev/pts/5"] = terminal[0]
                wanted = self._here(step.shown)
            if _SAME.check_output(wanted, found, doctest.ELLIPSIS):
                self._seen += len(found)
                return
            # What runs on may have more to say; what has ended has not.
            if not self._running or time.monotonic() > end:
                raise AssertionError(f"$ {step.command}\n{found}\ninstead of\n{wanted}")
            time.sleep(0.02)

    def _here(self, text: str) -> str:
        for theirs, ours in self._swaps.items():
            text = text.replace(theirs, ours)
        return text

    def _end(self) -> None:
        while self._running:
            process = self._running.pop()
            process.terminate()
            process.wait(PATIENCE)
