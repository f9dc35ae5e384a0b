"""Cases that provoke errors: what is typed, the exit status, and the place that the error names.

A case is an entry of a file in tests/errors/cases: `run`, a command line of `era`; `files` of its
own, or an `edit` of the prepared ones; what happens `before`; the exit `status`, 2 unless given;
`at`, the file with its line, the key or the option that the message names; `long` for one that only
`make test-long` takes. Entries under `variants` share their command line. A case that names
era.sock finds a daemon there.

Cases with `shown` are quoted in docs/reference/errors.md. `make pages` writes these quotations,
between `<!-- begin: cases of tests/errors -->` and `<!-- end -->`.
"""

import contextlib
import io
import os
import re
import shlex
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from cases import read_yaml
from controller.api.client import Client
from controller.api.jsonrpc import RpcError
from era_haptics.command import run_era
from kit.plates import DISTORTIONS, every
from model.response_files import measurement_of, read_measured, write_responses_csv
from model.rig.rig_file import example_rig_path, load_rig
from processes.gateways import real_daemon, wait_for

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "reference" / "errors.md"
HOME = "/home/you"
"""Stands on the page for the folder of a case, which is its home, too."""

RIG = """\
plate: {length: 12 in, width: 9 in, thickness: 1.5 mm, material: aluminium}
mesh: 12x9
eras:
  SW: {at: [0, 0], stiffness: 17000, amplifier: main, channel: 0}
  SE: {at: [12 in, 0], stiffness: 17000, amplifier: main, channel: 1}
  NE: {at: [12 in, 9 in], stiffness: 17000, amplifier: main, channel: 2}
  NW: {at: [0, 9 in], stiffness: 17000, amplifier: main, channel: 3}
amplifiers:
  main: {url: "sim://"}
limits:
  frequency: [40, 300]
"""

INTERNALS = re.compile(
    r"Traceback|File \"|<class |object at 0x|np\.\w+\(|PosixPath\(|\[Errno|Field required|"
    r"(Input|String|List) should|Error\(|local variable"
)
"""Words of Python and of libraries, which help no user."""

_PREPARED = {
    "rig.yaml": RIG,
    "daemon.yaml": "rig: rig.yaml\n",
    "layout.yaml": "effects:\n  tick: {kind: click}\n"
    "regions:\n  ok: {circle: {at: [0.1, 0.1], radius: 0.02}, on_press: tick}\n",
}
_SOCKET, _DAEMON = "era.sock", "running"


@dataclass(frozen=True)
class Case:
    """One way to get an error.

    blur: a pattern of what differs in each run; long: whether `make test-long` alone takes it.
    """

    name: str
    run: str
    status: int = 2
    at: list[str] = field(default_factory=list)
    files: dict[str, str | bytes] = field(default_factory=dict)
    edit: dict[str, list[str]] = field(default_factory=dict)
    before: str | None = None
    said: str = ""
    blur: str | None = None
    shown: bool = False
    long: bool = False

    @property
    def typed(self) -> list[str]:
        """The lines that provoke it, as the page quotes them."""
        lines = [f"# {name}: {old} -> {new}" for name, (old, new) in self.edit.items()]
        for name, content in self.files.items():
            content = content if isinstance(content, str) else repr(content)
            lines += [f"# {name}: {line}" for line in content.splitlines()]
        return [line.replace("\n", " / ") for line in lines] + [f"$ {self.run}"]


@dataclass(frozen=True)
class Outcome:
    """How a case ended; changed: files that it wrote, altered or removed."""

    text: str
    status: int
    out: str
    changed: frozenset[str]


@cache
def cases() -> tuple[Case, ...]:
    """All cases, in the order of their files."""
    listed_cases: list[Case] = []
    for path in sorted((ROOT / "tests" / "errors" / "cases").glob("*.yaml")):
        entries: list[dict[str, Any]] = read_yaml(path)
        flat = [
            {"run": entry["run"], **variant}
            for entry in entries
            for variant in entry.get("variants", [entry])
        ]
        for number, case in enumerate(flat, start=1):
            at = case.pop("at", [])
            places = at if isinstance(at, list) else [at]
            listed_cases.append(Case(name=f"{path.stem}-{number}", at=places, **case))
    return tuple(listed_cases)


def provoke(case: Case, folder: Path, shelf: Path) -> Outcome:
    """Run a case in a folder of its own; shelf: holds what is slow to make."""
    _lay_out(case, folder, shelf)
    former_files = _files(folder)
    out, err = io.StringIO(), io.StringIO()
    with _at_home(folder), contextlib.ExitStack() as stack:
        if case.before:
            _BEFORE[case.before](stack, out)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            program, *arguments = shlex.split(case.run)
            assert program == "era"
            status = run_era(arguments)
    text = err.getvalue().replace(str(folder), HOME)
    if case.blur:
        text = re.sub(case.blur, "...", text)
    changed = frozenset(str(path) for path, _ in former_files ^ _files(folder))
    return Outcome(text, status, out.getvalue(), changed)


def _files(folder: Path) -> set[tuple[Path, bytes]]:
    """The files in a folder but for the cache."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    within = ((path.relative_to(folder), path) for path in paths)
    return {(name, path.read_bytes()) for name, path in within if name.parts[0] != ".cache"}


def _lay_out(case: Case, folder: Path, shelf: Path) -> None:
    mentioned = " ".join(map(str, (case.run, case.edit, *case.files.values())))
    for name, text in _PREPARED.items():
        if name in mentioned or name == "rig.yaml":
            (folder / name).write_text(text, encoding="utf-8")
    for path in shelf.iterdir():
        if path.name in mentioned and path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    if _SOCKET in mentioned:
        (folder / _SOCKET).symlink_to(shelf / _DAEMON / _SOCKET)
    for name, (old, new) in case.edit.items():
        text = (folder / name).read_text("utf-8")
        assert old in text, f"{case.name}: {name} has no {old!r} to be changed"
        (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")
    for name, content in case.files.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())


@contextlib.contextmanager
def _at_home(folder: Path) -> Iterator[None]:
    """Make this folder the current one, the home, and that of caches and sockets."""
    former_folder, environment = Path.cwd(), dict(os.environ)
    os.chdir(folder)
    os.environ.update(
        HOME=str(folder),
        XDG_CACHE_HOME=str(folder / ".cache"),
        XDG_RUNTIME_DIR=str(folder),
        COLUMNS="100",
        NO_COLOR="1",
    )
    try:
        yield
    finally:
        os.chdir(former_folder)
        os.environ.clear()
        os.environ.update(environment)


def _without_aiohttp(stack: contextlib.ExitStack, _: io.StringIO) -> None:
    stack.callback(sys.modules.__setitem__, "aiohttp", import_module("aiohttp"))
    sys.modules["aiohttp"] = None  # type: ignore[assignment]  # as where it is not installed


def _disarmed(stack: contextlib.ExitStack) -> Client:
    """A client of the running daemon, which is disarmed first."""
    client = stack.enter_context(Client.connect(Path(_SOCKET), name="another"))
    wait_for(lambda: client.status().state != "NOT_READY")
    with contextlib.suppress(RpcError):  # it may be stopped
        client.disarm()
    client.clear()
    wait_for(lambda: client.status().state == "READY_TO_SWITCH_ON")
    return client


def _armed_by_another(stack: contextlib.ExitStack, _: io.StringIO) -> None:
    _disarmed(stack).arm("another")


def _stopped_once_armed(stack: contextlib.ExitStack, out: io.StringIO) -> None:
    client = _disarmed(stack)

    def stop() -> None:
        wait_for(out.getvalue)  # it says so once it is armed
        client.stop()

    thread = threading.Thread(target=stop)
    thread.start()
    stack.callback(thread.join)


_BEFORE: dict[str, Callable[[contextlib.ExitStack, io.StringIO], None]] = {
    "without_aiohttp": _without_aiohttp,
    "armed_by_another": _armed_by_another,
    "stopped_once_armed": _stopped_once_armed,
}


def _write_distorted(shelf: Path) -> None:
    """Put measured responses on the shelf that are not what they claim, such as g.csv."""
    rig = load_rig(example_rig_path())
    measured = measurement_of(read_measured(ROOT / "examples" / "measured.csv"), rig)
    few = every(measured, 2, up_to=300.0)
    for name in ("g", "conjugated", "swapped_channels", "swapped_sensors"):
        write_responses_csv(shelf / f"{name}.csv", DISTORTIONS[name](few), rig)


@contextlib.contextmanager
def filled(shelf: Path) -> Iterator[None]:
    """Put a small table and copies of examples on a shelf, and run a daemon meanwhile."""
    (shelf / "rig.yaml").write_text(RIG, encoding="utf-8")
    table = f"table build {shelf}/rig.yaml -o {shelf}/table.npz --frequencies 60:120:30 --grid 4x3"
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert run_era(shlex.split(table)) == 0
    (shelf / "rig.yaml").unlink()
    for name in ("measured.csv", "measured.uff", "touches.tuio"):
        (shelf / name).write_bytes((ROOT / "examples" / name).read_bytes())
    _write_distorted(shelf)
    (shelf / _DAEMON).mkdir()
    with real_daemon(shelf / _DAEMON):
        yield


_TYPED = re.compile(r"# [\w.]+: |\$ ")
"""A line of a file, or a command; other lines of `#` are words."""


@dataclass(frozen=True)
class Quotation:
    """An error of the page: the lines that are typed, the message, and the promised status."""

    typed: list[str]
    text: str
    status: int


def quotations(page: str) -> list[Quotation]:
    """The errors of the page in their order, each with the exit status of its section.

    Blank lines separate the errors of a block.
    """
    quoted, status = [], -1
    for section in page.split("\n## ")[1:]:
        if promised := re.search(r"exit status (\d)", section.splitlines()[0]):
            status = int(promised[1])
        for box in section.split("```text\n")[1:]:
            for entry in box.split("\n```")[0].split("\n\n"):
                lines = entry.splitlines()
                typed = [line for line in lines if _TYPED.match(line)]
                text = lines[lines.index(typed[-1]) + 1 :]
                quoted.append(Quotation(typed, "\n".join(text), status))
    return quoted


def with_messages(page: str) -> str:
    """The page with the present message of every error that it quotes."""
    shown_cases = {tuple(case.typed): case for case in cases() if case.shown}
    with tempfile.TemporaryDirectory() as shelf, filled(Path(shelf)):
        for quoted in quotations(page):
            case = shown_cases[tuple(quoted.typed)]
            with tempfile.TemporaryDirectory() as folder:
                text = provoke(case, Path(folder), Path(shelf)).text.rstrip("\n")
            typed = "\n".join(quoted.typed)
            page = page.replace(f"\n{typed}\n{quoted.text}\n", f"\n{typed}\n{text}\n")
    return page
