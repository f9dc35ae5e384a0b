import os
import signal
import subprocess
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from textwrap import dedent

import pytest

from controller.cli.main import main, run

GROUP = "era_haptics.commands"

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

    parts = typer.Typer(help="Some parts.", no_args_is_help=True)
    app.add_typer(parts, name="parts")

    @parts.command("list")
    def list_parts() -> None:
        "Name the parts."
        print("none")
"""


@pytest.fixture
def entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[EntryPoint]:
    """A package with commands, installed for one test."""
    return [entry(tmp_path, monkeypatch, "era_test_commands", COMMANDS)]


def entry(folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, source: str) -> EntryPoint:
    """An entry point to a module of this source, which is forgotten after the test."""
    (folder / f"{name}.py").write_text(dedent(source), encoding="utf-8")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, name, raising=False)
    return EntryPoint(name=name, value=name, group=GROUP)


def process(folder: Path, *arguments: str, **environment: str) -> "subprocess.Popen[str]":
    """A process that runs the test commands of a folder."""
    script = (
        "import sys; from importlib.metadata import EntryPoint; import controller.cli.main as m; "
        f"m.entry_points = lambda group: [EntryPoint('t', 'era_test_commands', {GROUP!r})]; "
        "sys.exit(m.main())"
    )
    return subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        env={**os.environ, "PYTHONPATH": str(folder), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_command_runs_and_its_status_is_zero(
    entries: list[EntryPoint], capsys: pytest.CaptureFixture[str]
) -> None:
    """Commands and groups of a package stand at the root, with their options."""
    assert run(["good", "--number", "5"], entries) == 0
    assert run(["parts", "list"], entries) == 0
    written = capsys.readouterr()
    assert written.out.startswith("number 5 ")
    assert written.out.endswith("none\n")
    assert written.err == ""


@pytest.mark.parametrize(
    ("how", "status", "paragraph"),
    [
        ("refused", 1, ""),
        ("worse", 2, "era: error: rig.yaml:3: plate.length: is missing; add it\n"),
        ("unplugged", 3, "era: error: the line is gone; plug it in\n"),
        ("file", 2, "era: error: /no/such/file: no such folder /no/such; create it"),
        (
            "bug",
            70,
            "era: error: this is a bug in era-haptics, please report it (KeyError: 'oops')",
        ),
        ("interrupt", 130, ""),
        ("abort", 130, ""),
    ],
)
def test_every_ending_has_its_status_and_paragraph(
    entries: list[EntryPoint],
    capsys: pytest.CaptureFixture[str],
    how: str,
    status: int,
    paragraph: str,
) -> None:
    """An error is one paragraph on standard error and nothing else; its status is the package's."""
    assert run(["ends", how], entries) == status
    written = capsys.readouterr()
    assert written.out == ""
    assert written.err.startswith(paragraph)
    assert written.err.count("\n") == (1 if paragraph else 0)


@pytest.mark.parametrize(
    ("arguments", "paragraph"),
    [
        (["god"], "No such command 'god'. Did you mean 'good'? See  era --help"),
        (["good", "--nmber", "1"], "era good --help"),
        (["good", "--number", "x"], "era good --help"),
        (["ends"], "See  era ends --help"),
        (["parts", "lst"], "See  era parts --help"),
        (["--wrong"], "See  era --help"),
    ],
)
def test_bad_usage_has_status_two(
    entries: list[EntryPoint],
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    paragraph: str,
) -> None:
    """What cannot be understood is said in one line that points to the right help."""
    assert run(arguments, entries) == 2
    written = capsys.readouterr()
    assert written.err.startswith("era: error: ")
    assert paragraph in written.err
    assert written.err.count("\n") == 1


@pytest.mark.parametrize("arguments", [[], ["parts"]])
def test_a_left_out_command_shows_the_help(
    entries: list[EntryPoint], capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    """The help stands there as it is, not as an error message."""
    assert run(arguments, entries) == 2
    assert capsys.readouterr().err.startswith("Usage: era")


@pytest.mark.parametrize(
    "arguments",
    [["--debug", "ends", "bug"], ["ends", "--debug", "bug"], ["ends", "bug", "--debug"]],
)
def test_debug_shows_where_an_error_arose(
    entries: list[EntryPoint], capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    """The option is accepted anywhere; the traceback is Python's own, without colour."""
    assert run(arguments, entries) == 70
    written = capsys.readouterr()
    assert "Traceback (most recent call last):" in written.err
    assert "\x1b" not in written.err


def test_debug_after_two_dashes_is_an_argument(
    entries: list[EntryPoint], capsys: pytest.CaptureFixture[str]
) -> None:
    """Behind `--` stand arguments; --debug is one of them there."""
    assert run(["ends", "--", "--debug"], entries) == 70
    written = capsys.readouterr()
    assert "KeyError: '--debug'" in written.err
    assert "Traceback" not in written.err


@pytest.mark.parametrize(
    "source",
    [
        "import no_such_dependency",
        "this is no Python",
        "import typer; app = typer.Typer()",
        "EXIT_STATUS = {}",
        "import typer; app = typer.Typer(); EXIT_STATUS = {}; app.command()(lambda good: 0)"
        "; app.command('good')(lambda: 0)",
        "import typer; app = typer.Typer(); EXIT_STATUS = {}; app.command('q')(lambda x: 0)"
        "; app.command('r')(lambda x, *y: 0); raise ValueError(1)",
    ],
)
def test_a_broken_package_leaves_the_others_alone(
    entries: list[EntryPoint],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    source: str,
) -> None:
    """What cannot be loaded, or repeats a command, is named on standard error and left out."""
    broken = entry(tmp_path, monkeypatch, "era_test_broken", source)
    assert run(["good"], [*entries, broken]) == 0
    written = capsys.readouterr()
    assert written.out.startswith("number 1 ")
    assert written.err.startswith("era: warning: ")
    assert "era_test_broken" in written.err
    assert written.err.count("\n") == 1


def test_help_and_version(entries: list[EntryPoint], capsys: pytest.CaptureFixture[str]) -> None:
    """Both go to standard output; the program is called era whatever started it."""
    assert run(["--version"], entries) == 0
    assert capsys.readouterr().out == "era-haptics 0.1.0\n"
    assert run(["--help"], entries) == 0
    text = capsys.readouterr().out
    assert text.startswith("Usage: era ")
    assert all(word in text for word in ("good", "ends", "parts", "--version", "--debug"))


def test_a_reader_that_leaves_is_no_error(tmp_path: Path) -> None:
    """`era ... | head` ends quietly."""
    (tmp_path / "era_test_commands.py").write_text(dedent(COMMANDS), encoding="utf-8")
    with process(tmp_path, "flood") as flood:
        assert flood.stdout is not None
        assert flood.stderr is not None
        assert flood.stdout.readline() == "line 0\n"
        flood.stdout.close()
        assert flood.stderr.read() == ""
        assert flood.wait() == 141


@pytest.mark.parametrize(("given", "seen"), [({}, "1"), ({"OMP_NUM_THREADS": "7"}, "7")])
def test_linear_algebra_gets_one_thread_unless_told_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: dict[str, str], seen: str
) -> None:
    """The number is set before any command is loaded; a user's own choice is kept."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    (tmp_path / "era_test_commands.py").write_text(dedent(COMMANDS), encoding="utf-8")
    with process(tmp_path, "good", **given) as good:
        assert good.communicate()[0] == f"number 1 {seen}\n"


LOADED = """
import contextlib, io, sys
from importlib.metadata import entry_points, packages_distributions
from controller.cli.main import load_commands
from controller.cli.main import run

points = entry_points(group="era_haptics.commands")
if "all" in sys.argv:
    def help_of(command, path):
        yield path
        for name, part in getattr(command, "commands", {}).items():
            yield from help_of(part, [*path, name])
    paths = list(help_of(load_commands(points, debug=True)[0], []))
else:
    paths = [[]]
with contextlib.redirect_stdout(io.StringIO()):
    assert [run([*path, "--help"], points) for path in paths] == [0] * len(paths)
heavy = {"asyncio", "ssl", *packages_distributions()}
print(len(paths), *sorted(heavy & {name.partition(".")[0] for name in sys.modules}))
"""


@pytest.mark.parametrize(
    ("which", "others"),
    [
        ("", set()),
        # typer describes the options of a command with pydantic where that is installed.
        ("all", {"asyncio", "ssl", "pydantic", "pydantic_core", "annotated_types"}),
    ],
)
def test_help_loads_nothing_heavy(which: str, others: set[str]) -> None:
    """Help is quick because of all that is installed it loads our commands and typer alone."""
    done = subprocess.run(
        [sys.executable, "-c", LOADED, which], capture_output=True, text=True, check=True
    )
    count, *loaded = done.stdout.split()
    assert int(count) == 1 if not which else int(count) > 40
    ours = {"registry", "controller", "drivers", "model", "sim"}
    typers = {"typer", "annotated_doc", "shellingham", "typing_extensions", "typing_inspection"}
    of_the_environment = {"_distutils_hack"}  # of setuptools
    assert set(loaded) - ours - typers - of_the_environment - others == set()


def test_every_package_of_the_project_can_be_loaded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The installed command starts without a warning, with the commands of all packages."""
    monkeypatch.setattr(sys, "argv", ["era", "--help"])
    monkeypatch.setattr(signal, "signal", lambda *_: None)  # the tests' own ending stays theirs
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(variable, "1")  # main sets them; so they are put back after the test
    installed = {point.name for point in entry_points(group=GROUP)}
    assert installed == {
        "controller",
        "daemon",
        "deploy",
        "drivers",
        "gateway",
        "model",
        "report",
        "sim",
    }
    assert main() == 0
    assert capsys.readouterr().err == ""
