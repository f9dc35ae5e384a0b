"""The `era` command: commands of modules, errors and their exit statuses."""

import os
import signal
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from textwrap import dedent

import pytest

from controller.cli.main import main, run

MODULE = "era_test_commands"

COMMANDS = """
    import os
    import typer

    class Unplugged(ConnectionError):
        pass

    class BadRig(ValueError):
        pass

    class WorseRig(BadRig):
        pass

    app = typer.Typer()
    app.callback()(lambda: None)
    EXIT_STATUS = {Unplugged: 3, BadRig: 2}

    @app.command()
    def good(number: int = 1) -> None:
        "Say a number."
        print("number", number, os.environ.get("OMP_NUM_THREADS"))

    @app.command()
    def ends(how: str) -> None:
        "End in a given way."
        if how == "file":
            open("/no/such/file")
        if how == "refused":
            raise typer.Exit(1)
        raise {
            "unplugged": Unplugged("the line is gone; plug it in"),
            "worse": WorseRig("rig.yaml:3: plate.length: is missing; add it"),
            "bug": KeyError("oops"),
            "interrupt": KeyboardInterrupt(),
            "abort": typer.Abort(),
        }[how]

    @app.command()
    def flood() -> None:
        "Print far more than a pipe holds."
        for line in range(100_000):
            print("line", line)

    @app.command()
    def letters() -> None:
        "Print letters that are not ASCII, and a byte that is no letter."
        print("m/s" + chr(0xB2), "p" + chr(0xDCFC))

    parts = typer.Typer(help="Some parts.", no_args_is_help=True)
    app.add_typer(parts, name="parts")

    @parts.command("list")
    def list_parts() -> None:
        "Name the parts."
        print("none")
"""


@pytest.fixture
def entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A module with commands, which is forgotten after the test."""
    (tmp_path / f"{MODULE}.py").write_text(dedent(COMMANDS), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    return [MODULE]


def process(folder: Path, *arguments: str, **environment: str) -> "subprocess.Popen[str]":
    """A process that runs the test commands of a folder."""
    script = (
        f"import controller.cli.main as m; m.COMMANDS = [{MODULE!r}]; raise SystemExit(m.main())"
    )
    return subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        env={**os.environ, "PYTHONPATH": str(folder), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_run_runs_a_command_and_returns_zero(
    entries: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """Commands and groups of a package are at the root, with their options."""
    assert run(["good", "--number", "5"], entries) == 0
    assert run(["parts", "list"], entries) == 0
    written = capsys.readouterr()
    assert written.out.startswith("number 5 ")
    assert written.out.endswith("none\n")
    assert written.err == ""


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["ends", "refused"], 1, ""),
        (["ends", "worse"], 2, "rig.yaml:3: plate.length: is missing; add it"),
        (["ends", "unplugged"], 3, "the line is gone; plug it in"),
        (["ends", "file"], 2, "/no/such/file: no such folder /no/such"),
        (["ends", "bug"], 70, "KeyError: 'oops'"),
        (["ends", "--", "--debug"], 70, "KeyError: '--debug'"),
        (["ends", "interrupt"], 130, ""),
        (["ends", "abort"], 130, ""),
        (["god"], 2, "Did you mean 'good'? See era --help"),
        (["version"], 2, "Did you mean --version? See era --help"),
        (["good", "--nmber", "1"], 2, "era good --help"),
        (["good", "--number", "x"], 2, "era good --help"),
        (["ends"], 2, "era ends --help"),
        (["parts", "lst"], 2, "era parts --help"),
        (["--wrong"], 2, "era --help"),
    ],
)
def test_run_reports_an_error_in_one_line_with_its_status(
    entries: list[str],
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    status: int,
    words: str,
) -> None:
    """On standard error; the status is that of the package, bad usage names the right help."""
    assert run(arguments, entries) == status
    written = capsys.readouterr()
    assert written.out == ""
    assert written.err.startswith("era: error: " if words else "")
    assert words in written.err
    assert written.err.count("\n") == (1 if words else 0)


@pytest.mark.parametrize("arguments", [[], ["parts"]])
def test_run_shows_the_help_without_a_command(
    entries: list[str], capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    """As it is, not as an error message."""
    assert run(arguments, entries) == 2
    assert capsys.readouterr().err.startswith("Usage: era")


@pytest.mark.parametrize(
    "arguments",
    [["--debug", "ends", "bug"], ["ends", "--debug", "bug"], ["ends", "bug", "--debug"]],
)
def test_run_shows_the_traceback_with_debug(
    entries: list[str], capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    """The option is accepted anywhere; the traceback has no colour."""
    assert run(arguments, entries) == 70
    written = capsys.readouterr()
    assert "Traceback (most recent call last):" in written.err
    assert "\x1b" not in written.err


def test_run_prints_help_and_version(
    entries: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """On standard output; the program is called era however it was started."""
    assert run(["--version"], entries) == 0
    assert capsys.readouterr().out == f"era-haptics {version('era-haptics')}\n"
    assert run(["--help"], entries) == 0
    text = capsys.readouterr().out
    assert text.startswith("Usage: era ")
    assert all(word in text for word in ("good", "ends", "parts", "--version", "--debug"))


def test_main_ends_quietly_when_its_reader_closes(tmp_path: Path) -> None:
    """As in `era ... | head`."""
    (tmp_path / "era_test_commands.py").write_text(dedent(COMMANDS), encoding="utf-8")
    with process(tmp_path, "flood") as flood:
        assert flood.stdout is not None
        assert flood.stderr is not None
        assert flood.stdout.readline() == "line 0\n"
        flood.stdout.close()
        assert flood.stderr.read() == ""
        assert flood.wait() == 141


def test_main_ends_well_without_an_output(entries, monkeypatch: pytest.MonkeyPatch) -> None:
    """Started with a closed standard output, for which Python has None, as by some services."""
    monkeypatch.setattr("sys.stdout", None)
    assert run(["--version"], entries) == 0


def test_main_prints_what_its_output_cannot_encode(tmp_path: Path) -> None:
    """Escaped: a unit in an output of ASCII, and the name of a file that is not UTF-8."""
    (tmp_path / "era_test_commands.py").write_text(dedent(COMMANDS), encoding="utf-8")
    with process(tmp_path, "letters", PYTHONIOENCODING="ascii") as letters:
        assert letters.communicate()[0] == "m/s\\xb2 p\\udcfc\n"
        assert letters.returncode == 0


@pytest.mark.parametrize(("given", "seen"), [({}, "1"), ({"OMP_NUM_THREADS": "7"}, "7")])
def test_main_limits_linear_algebra_to_one_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: dict[str, str], seen: str
) -> None:
    """Before any command is loaded, unless the user has chosen."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    (tmp_path / "era_test_commands.py").write_text(dedent(COMMANDS), encoding="utf-8")
    with process(tmp_path, "good", **given) as good:
        assert good.communicate()[0] == f"number 1 {seen}\n"


LOADED = """
import contextlib, io, sys
from importlib.metadata import packages_distributions
from controller.cli.main import load_commands
from controller.cli.main import run

if "all" in sys.argv:
    def help_of(command, path):
        yield path
        for name, part in getattr(command, "commands", {}).items():
            yield from help_of(part, [*path, name])
    paths = list(help_of(load_commands()[0], []))
else:
    paths = [[]]
with contextlib.redirect_stdout(io.StringIO()):
    assert [run([*path, "--help"]) for path in paths] == [0] * len(paths)
heavy = {"asyncio", "ssl", *packages_distributions()}
print(len(paths), *sorted(heavy & {name.partition(".")[0] for name in sys.modules}))
"""


@pytest.mark.parametrize(
    ("which", "others"),
    [
        ("", set()),
        # typer describes the options of a command with pydantic where that is installed.
        pytest.param(
            "all",
            {"asyncio", "ssl", "pydantic", "pydantic_core", "annotated_types"},
            marks=pytest.mark.long,
        ),
    ],
)
def test_help_loads_commands_and_typer_alone(which: str, others: set[str]) -> None:
    """So that it is quick."""
    done = subprocess.run(
        [sys.executable, "-c", LOADED, which], capture_output=True, text=True, check=True
    )
    count, *loaded = done.stdout.split()
    assert int(count) == 1 if not which else int(count) > 40
    ours = {"registry", "controller", "drivers", "model", "sim"}
    typers = {"typer", "annotated_doc", "shellingham", "typing_extensions", "typing_inspection"}
    of_the_environment = {"_distutils_hack"}  # of setuptools
    assert set(loaded) - ours - typers - of_the_environment - others == set()


def test_main_loads_every_package_of_the_project(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without a warning."""
    monkeypatch.setattr(sys, "argv", ["era", "--help"])
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # keep those of pytest
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(variable, "1")  # main sets them; restored after the test
    assert main() == 0
    assert capsys.readouterr().err == ""
