"""Somebody who follows a page to the letter: types, edits, opens terminals and ends them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from printed import difference
from tutorial_page import Edited, Interrupted, PageError, Step, Typed, Written

PATIENCE = 60.0  # s; for one command, on a machine that is busy with other things
LOOK_AGAIN = 0.05  # s


class Reader:
    """Does steps in a folder; leave the block to have every terminal closed.

    folder: where the files go. home: a short path for what programs keep, sockets among them.
    """

    def __init__(self, folder: Path, *, home: Path) -> None:
        self._folder = folder
        self._environment = {
            "HOME": str(home),
            "LANG": "C.UTF-8",
            "NO_COLOR": "1",
            "COLUMNS": "100",
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONUNBUFFERED": "1",
            "OPENBLAS_NUM_THREADS": "1",
            "TMPDIR": str(home),
            "XDG_CACHE_HOME": str(home / "cache"),
            "XDG_RUNTIME_DIR": str(home),
        }
        self._terminals: dict[str, tuple[subprocess.Popen[bytes], Path]] = {}

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_: object) -> None:
        for process, _output in self._terminals.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def follow(self, step: Step) -> None:
        """Do one step; raises PageError where anything else comes of it than the page says."""
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

    def _edit(self, step: Edited) -> None:
        path = self._folder / step.name
        text = path.read_text(encoding="utf-8")
        if text.count(step.old) != 1:
            raise PageError(f"line {step.line}: {text.count(step.old)} times in {step.name}")
        path.write_text(text.replace(step.old, step.new), encoding="utf-8")

    def _type(self, step: Typed) -> None:
        done = subprocess.run(
            ["bash", "-e", "-c", step.commands],
            cwd=self._folder,
            env=self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        if done.returncode != step.status:
            raise PageError(f"line {step.line}: exit status {done.returncode}\n{done.stdout}")
        _compare(step.line, step.shown, done.stdout)

    def _begin(self, step: Typed) -> None:
        assert step.terminal is not None
        output = self._folder.parent / f"{step.terminal}.txt"
        with output.open("wb") as file:
            process = subprocess.Popen(
                ["bash", "-c", step.commands],
                cwd=self._folder,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._terminals[step.terminal] = process, output
        shown = (step.shown or "").rstrip("\n") + "\n..."
        latest = time.monotonic() + PATIENCE
        while difference(shown, output.read_text(encoding="utf-8")) is not None:
            if time.monotonic() > latest or process.poll() is not None:
                _compare(step.line, shown, output.read_text(encoding="utf-8"))
                break
            time.sleep(LOOK_AGAIN)

    def _interrupt(self, step: Interrupted) -> None:
        process, output = self._terminals[step.terminal]
        os.killpg(process.pid, signal.SIGINT)
        try:
            process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            raise PageError(f"line {step.line}: goes on\n{output.read_text('utf-8')}") from None


def _compare(line: int, shown: str | None, printed: str) -> None:
    if shown is not None and (what := difference(shown, printed)) is not None:
        raise PageError(f"line {line}: {what}\n\n{printed}")
