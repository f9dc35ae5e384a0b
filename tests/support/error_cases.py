"""Cases that provoke errors, what each says, and the page that all of them make.

A case is an entry of a file in tests/errors/cases: what is typed (`run`, a command line of `era`,
or `python`, code of the library), with files of its own (`files`, `edit` of the prepared ones) and
code that comes before a command (`before`). Code has an ExitStack, `until_over`, and raises, or
names what was `told` to it. A case that names era.sock finds a daemon there.
What it says stands in docs/reference/errors.md alone, which
`python tests/support/error_cases.py` writes anew; read every changed line of it.
"""

import contextlib
import io
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from controller.api.jsonrpc import RpcError
from controller.cli.main import run
from drivers.errors import DriverError
from gateway_bench import real_daemon
from model.errors import InputError

HERE = Path(__file__).parents[1] / "errors"
PAGE = HERE.parents[1] / "docs" / "reference" / "errors.md"
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

_PREPARED = {
    "rig.yaml": RIG,
    "daemon.yaml": "rig: rig.yaml\n",
    "layout.yaml": "effects:\n  tick: {kind: click}\n"
    "regions:\n  ok: {circle: {at: [0.1, 0.1], radius: 0.02}, on_press: tick}\n",
}


SOCKET, _DAEMON = "era.sock", "running"


@dataclass(frozen=True)
class Case:
    """One way to get an error. status: None for code, which raises; said: begins what came first.

    blur: a pattern of what is another at each run.
    """

    name: str
    subject: str
    run: str | None = None
    python: str | None = None
    status: int | None = None
    files: dict[str, str | bytes] = field(default_factory=dict)
    edit: dict[str, list[str]] = field(default_factory=dict)
    blur: str | None = None
    before: str = ""
    said: str = ""
    prelude: str = ""


@dataclass(frozen=True)
class Subject:
    """A part of the page: a title, what to know, and its cases."""

    title: str
    about: str
    cases: tuple[Case, ...]


@dataclass(frozen=True)
class Told:
    """How a case ended; changed: files that it wrote, altered or removed."""

    text: str
    status: int | None
    out: str
    changed: frozenset[str] = frozenset()


@cache
def subjects() -> tuple[Subject, ...]:
    """All cases, in the order of their files."""
    return tuple(_subject(path) for path in sorted((HERE / "cases").glob("*.yaml")))


def _subject(path: Path) -> Subject:
    given: dict[str, Any] = YAML(typ="safe", pure=True).load(path.read_text("utf-8"))
    stem = path.stem.split("-", 1)[1]
    cases = []
    for number, entry in enumerate(given["cases"], start=1):
        status = entry.pop("status", 2) if "run" in entry else None
        prelude = given.get("python", "")
        cases.append(
            Case(name=f"{stem}-{number}", subject=stem, status=status, prelude=prelude, **entry)
        )
    return Subject(given["title"], given.get("about", ""), tuple(cases))


def provoke(case: Case, folder: Path, shelf: Path) -> Told:
    """Run a case in a folder of its own; shelf: where files lie that are dear to make."""
    _lay_out(case, folder, shelf)
    before = _files(folder)
    with _at_home(folder):
        told = _run(case) if case.run is not None else _call(case)
    text = told.text.replace(str(folder), HOME)
    if case.blur:
        text = re.sub(case.blur, "...", text)
    changed = frozenset(str(path) for path, _ in before ^ _files(folder))
    return Told(text, told.status, told.out, changed)


def _files(folder: Path) -> set[tuple[Path, bytes]]:
    """What lies in a folder, but for the cache."""
    found = (path for path in folder.rglob("*") if path.is_file())
    within = ((path.relative_to(folder), path) for path in found)
    return {(name, path.read_bytes()) for name, path in within if name.parts[0] != ".cache"}


def _lay_out(case: Case, folder: Path, shelf: Path) -> None:
    typed = (case.prelude, case.before, case.run, case.python, *case.files.values())
    asked = " ".join(map(str, typed))
    for name, text in _PREPARED.items():
        if name in asked or name in case.edit or name == "rig.yaml":
            (folder / name).write_text(text, encoding="utf-8")
    for path in shelf.iterdir():
        if path.name in asked and path.is_file():
            (folder / path.name).write_bytes(path.read_bytes())
    if SOCKET in asked:
        (folder / SOCKET).symlink_to(shelf / _DAEMON / SOCKET)
    for name, (old, new) in case.edit.items():
        text = (folder / name).read_text("utf-8")
        assert old in text, f"{case.name}: {name} has no {old!r} to be changed"
        (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")
    for name, content in case.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())


@contextlib.contextmanager
def _at_home(folder: Path) -> Iterator[None]:
    """Everything that a command looks for or leaves behind lies in this folder."""
    before, kept = Path.cwd(), dict(os.environ)
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
        os.chdir(before)
        os.environ.clear()
        os.environ.update(kept)


def _run(case: Case) -> Told:
    assert case.run is not None
    program, *arguments = shlex.split(case.run)
    assert program == "era"
    out, err = io.StringIO(), io.StringIO()
    with contextlib.ExitStack() as until_over:
        if case.before:
            names: dict[str, Any] = {"until_over": until_over}
            exec(case.prelude, names)
            exec(case.before, names)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = run(arguments, entry_points(group="era_haptics.commands"))
    return Told(err.getvalue(), status, out.getvalue())


def _call(case: Case) -> Told:
    assert case.python is not None
    with contextlib.ExitStack() as until_over:
        names: dict[str, Any] = {"until_over": until_over}
        try:
            exec(case.prelude, names)
            exec(case.python, names)
        except (InputError, DriverError, RpcError) as error:
            return Told(f"{type(error).__name__}: {error}\n", None, "")
    if "told" in names:
        return Told(f"{names['told']}\n", None, "")
    raise AssertionError(f"{case.name}: nothing was wrong")


@contextlib.contextmanager
def filled(shelf: Path) -> Iterator[None]:
    """What is dear to make: a small table, copies of examples, and a daemon that runs meanwhile."""
    (shelf / "rig.yaml").write_text(RIG, encoding="utf-8")
    table = f"table build {shelf}/rig.yaml -o {shelf}/table.npz --frequencies 60:120:30 --grid 4x3"
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert run(shlex.split(table), entry_points(group="era_haptics.commands")) == 0
    (shelf / "rig.yaml").unlink()
    for name in ("measured.csv", "measured.uff", "touches.tuio"):
        (shelf / name).write_bytes((HERE.parents[1] / "examples" / name).read_bytes())
    (shelf / _DAEMON).mkdir()
    with real_daemon(shelf / _DAEMON):
        yield


def page(told: dict[str, Told]) -> str:
    """The page of all cases with what they say."""
    lines = [
        "# What went wrong, and what to do",
        "",
        "Errors as they are printed; search this page for words of yours. Each was provoked by",
        "what stands above it, mostly with the rig `rig.yaml` at the end of the page and a change.",
        "Exit status 2 is bad usage or input, 1 that the answer is no, 3 hardware or link.",
        "Written by `python tests/support/error_cases.py`.",
        "",
    ]
    for subject in subjects():
        lines += [f"## {subject.title}", ""]
        if subject.about:
            lines += [subject.about.strip(), ""]
        for case in subject.cases:
            lines += ["```text", *_typed(case), told[case.name].text.rstrip("\n"), "```", ""]
    lines += ["## The rig of these examples", "", "```yaml", RIG.rstrip("\n"), "```"]
    return "\n".join(lines) + "\n"


def _typed(case: Case) -> list[str]:
    lines = [f"# {name}: {old} -> {_short(new)}" for name, (old, new) in case.edit.items()]
    for name, content in case.files.items():
        shown = content.decode(errors="backslashreplace") if isinstance(content, bytes) else content
        lines += [f"# {name}:", *(f"#     {_short(line)}" for line in shown.splitlines()[:12])]
    if case.run is not None:
        return [*lines, *_code(case.before), f"$ {case.run}"]
    assert case.python is not None
    return [*lines, *_code(case.python)]


def _code(text: str) -> list[str]:
    return [
        f"{'...' if number else '>>>'} {line}"
        for number, line in enumerate(text.rstrip("\n").splitlines())
    ]


def _short(line: str) -> str:
    line = line.replace("\n", " / ")
    return line if len(line) <= 100 else f"{line[:100]}..."


def _main(wanted: list[str]) -> None:
    """Write the page; with names of subjects say what their cases say, and write nothing."""
    told: dict[str, Told] = {}
    with tempfile.TemporaryDirectory() as shelf, filled(Path(shelf)):
        for subject in subjects():
            for case in subject.cases:
                if wanted and case.subject not in wanted:
                    continue
                with tempfile.TemporaryDirectory() as folder:
                    try:
                        told[case.name] = provoke(case, Path(folder), Path(shelf))
                    except BaseException as error:
                        if not wanted:
                            raise
                        sys.stdout.write(f"!! {case.name} {type(error).__name__}: {error}\n")
                        continue
                if wanted:
                    said = told[case.name]
                    odd = f"  !! STATUS {said.status}" if said.status != case.status else ""
                    odd += f"  !! OUT {said.out[:300]}" if said.out else ""
                    sys.stdout.write("\n".join([*_typed(case), said.text + odd, ""]))
    if not wanted:
        PAGE.write_text(page(told), encoding="utf-8")


if __name__ == "__main__":
    _main(sys.argv[1:])
