"""A desk of real processes: jackd, a plate, and the commands that a user types."""

import contextlib
import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from model.arrays import FloatArray

ERA = Path(sys.executable).with_name("era")
PLATE = (sys.executable, "-m", "benchmarks.desk_plate", "rig.yaml", "--sensors", "sensors.csv")
EXAMPLES = Path(__file__).parents[2] / "examples" / "desk"
RATE, BLOCK = 48_000, 512
"""Hz, and frames: the most that an amplifier may take, for a machine without real-time priority."""

_START = 60.0  # s; on a busy machine
_END = 20.0  # s
_COMMAND = 900.0  # s
_TRIES = 2  # of a place

Place = tuple[float, float]

_numbers = itertools.count()


class Desk:
    """A running JACK server and its plate, in a folder with the example's rig and sensors."""

    def __init__(
        self, folder: Path, environment: Mapping[str, str], plate: "subprocess.Popen[str]"
    ) -> None:
        self.folder, self.environment = folder, dict(environment)
        self._plate = plate
        self._said = self._answered = 0

    def run(self, *arguments: object, status: int | None = 0) -> dict[str, Any]:
        """Run an `era` command with --json; None: any exit status. Raises RuntimeError."""
        done = subprocess.run(
            [str(ERA), *map(str, arguments), "--json"],
            capture_output=True,
            text=True,
            cwd=self.folder,
            env=self.environment,
            timeout=_COMMAND,
            check=False,
        )
        if status is not None and done.returncode != status:
            raise RuntimeError(
                f"era {' '.join(map(str, arguments))}: status {done.returncode}: {done.stderr}"
            )
        found: dict[str, Any] = json.loads(done.stdout)
        return found

    def touch_plate(self, fingers: Sequence[Sequence[float]]) -> None:
        """Put fingers on the plate: x and y of each [m], and the factor of its load if any."""
        self._change({"fingers": list(fingers)})

    def begin_feeling(self, seconds: float) -> None:
        """Keep for some time what the fingers feel; nothing else may change meanwhile."""
        self._say({"feel": seconds, "file": str(self.folder / "felt.npy")})

    def felt(self) -> FloatArray:
        """What they felt (n, k, p) [m/s²], as `DeskPlate.felt`."""
        self._answer()
        return np.asarray(np.load(self.folder / "felt.npy"))

    def log_count(self, word: str) -> int:
        """How many lines of the server and the plate have a word."""
        return (self.folder / "desk.log").read_text("utf-8", "replace").count(word)

    def measure_by_moving(self, *arguments: object) -> int:
        """Run `era measure` with one sensor, which is moved as it says; raises RuntimeError.

        Return how often a place was not kept: it is measured again once, and then skipped.
        """
        with subprocess.Popen(
            [str(ERA), "measure", *map(str, arguments)],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            bufsize=1,
            cwd=self.folder,
            env=self.environment,
        ) as process:
            assert process.stdin is not None
            assert process.stderr is not None
            said = ""
            while letter := process.stderr.read(1):
                said += letter
                if said.endswith("then Enter: "):
                    place = said.rpartition("sensor at ")[2].split(",")[0]
                    self._change({"sensor": place})
                    is_refused = said.count(f"{place} is not kept") >= _TRIES
                    process.stdin.write("s\n" if is_refused else "\n")
                    process.stdin.flush()
        if process.returncode:
            raise RuntimeError(f"era measure: status {process.returncode}: {said}")
        return said.count(" is not kept: ")

    def _change(self, what: Mapping[str, object]) -> None:
        self._say(what)
        self._answer()

    def _say(self, what: Mapping[str, object]) -> None:
        assert self._plate.stdin is not None
        self._plate.stdin.write(json.dumps(what) + "\n")
        self._plate.stdin.flush()
        self._said += 1

    def _answer(self) -> None:
        """Wait until the plate has done all that was said; raises RuntimeError if it has ended."""
        assert self._plate.stdout is not None
        while self._answered < self._said:
            if not self._plate.stdout.readline():
                log = (self.folder / "desk.log").read_text("utf-8", "replace")
                raise RuntimeError(f"the plate ended: {log}")
            self._answered += 1

    @property
    def truth(self) -> dict[str, Any]:
        """What the plate really is."""
        found: dict[str, Any] = json.loads((self.folder / "truth.json").read_text("utf-8"))
        return found


@contextlib.contextmanager
def desk(
    folder: Path,
    *,
    seed: int,
    mesh: str = "8x6 Q3",
    rig: str | None = None,
    sensors: str | None = None,
    options: Sequence[str] = (),
) -> Iterator[Desk]:
    """A desk with a plate of its own; seed: of its deviations.

    rig, sensors: content of other files than the example's; options: further ones of the plate.
    """
    name = f"desk{os.getpid()}-{next(_numbers)}"  # several plates may be on desks at once
    environment = os.environ | {
        "JACK_DEFAULT_SERVER": name,
        "JACK_NO_START_SERVER": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    link = folder / "amp"
    text = (EXAMPLES / "rig.yaml").read_text("utf-8") if rig is None else rig
    (folder / "rig.yaml").write_text(text.replace("/tmp/plate", str(link)), "utf-8")
    given = (EXAMPLES / "sensors.csv").read_text("utf-8") if sensors is None else sensors
    (folder / "sensors.csv").write_text(given, "utf-8")
    server = ["jackd", "-n", name, "-S", "-r", "-d", "dummy", "-p", str(BLOCK), "-r", str(RATE)]
    plate = [*PLATE, "--seed", seed, "--mesh", mesh, "--truth", "truth.json", "--until-eof"]
    plate += options
    with contextlib.ExitStack() as stack:
        stack.enter_context(_own_server(name))
        log = stack.enter_context((folder / "desk.log").open("w"))
        running(stack, server, folder, environment, log)
        process = _plate(stack, plate, folder, environment, log)
        yield Desk(folder, environment, process)


@contextlib.contextmanager
def _own_server(name: str) -> Iterator[None]:
    """Let clients in this process use a server."""
    before = os.environ.get("JACK_DEFAULT_SERVER")
    os.environ["JACK_DEFAULT_SERVER"] = name
    try:
        yield
    finally:
        del os.environ["JACK_DEFAULT_SERVER"]
        if before is not None:
            os.environ["JACK_DEFAULT_SERVER"] = before


def _plate(
    stack: contextlib.ExitStack,
    command: Sequence[object],
    folder: Path,
    environment: Mapping[str, str],
    log: IO[str],
) -> "subprocess.Popen[str]":
    """Start the plate as soon as the server is up."""
    end = time.monotonic() + _START
    while True:
        process = running(stack, command, folder, environment, log)
        assert process.stdout is not None
        if process.stdout.readline():
            return process
        if time.monotonic() > end:
            raise RuntimeError(f"no JACK server: {(folder / 'desk.log').read_text('utf-8')}")
        time.sleep(0.2)


def running(
    stack: contextlib.ExitStack,
    command: Sequence[object],
    folder: Path,
    environment: Mapping[str, str],
    log: IO[str],
) -> "subprocess.Popen[str]":
    """A process that ends with the stack: at the end of its input, or terminated."""
    process = stack.enter_context(
        subprocess.Popen(
            list(map(str, command)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            cwd=folder,
            env=environment,
        )
    )

    def end() -> None:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
        if "--until-eof" not in command:
            process.terminate()
        try:
            process.wait(_END)
        except subprocess.TimeoutExpired:
            process.kill()

    stack.callback(end)
    return process
