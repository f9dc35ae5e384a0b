"""The `era` command, errors and their exit statuses, and the socket reserved for one daemon."""

import errno
import os
import signal
import socket
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from textwrap import dedent

import pytest

from controller.cli.main import main, run
from controller.daemon.children import gateway_options
from controller.process.daemon_process import SocketLock
from interrupted import full_disk
from model.errors import InputError


def test_socket_is_for_its_user_only(tmp_path: Path) -> None:
    """Mode 0600 in a folder of mode 0700 whatever the umask, which stays; removed at the end."""
    before = os.umask(0)
    try:
        lock = SocketLock(tmp_path / "new" / "era.sock")
        with lock.bind():
            for name in ("era.sock", "era.sock.lock"):
                assert lock.path.with_name(name).stat().st_mode & 0o777 == 0o600
            assert lock.path.parent.stat().st_mode & 0o777 == 0o700
        assert os.umask(0) == 0
        lock.release()
        assert not lock.path.exists()
    finally:
        os.umask(before)


def test_client_that_sees_the_socket_is_never_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not before it listens either: it appears under its name afterwards, whatever was left."""
    path = tmp_path / "era.sock"

    class Looking(socket.socket):
        def listen(self, *backlog: int) -> None:
            assert not path.exists()
            super().listen(*backlog)

    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(f"{path}~")  # by a daemon that was killed before it listened
    lock = SocketLock(path)
    monkeypatch.setattr(socket, "socket", Looking)
    with lock.bind(), socket.socket(socket.AF_UNIX) as client:
        client.connect(str(path))
    lock.release()
    assert [each.name for each in tmp_path.iterdir()] == ["era.sock.lock"]


def test_socket_that_cannot_listen_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither under its name nor under the one before."""

    class Deaf(socket.socket):
        def listen(self, *backlog: int) -> None:
            raise OSError(98, "Address already in use")

    lock = SocketLock(tmp_path / "era.sock")
    monkeypatch.setattr(socket, "socket", Deaf)
    with pytest.raises(InputError, match="Address already in use"):
        lock.bind()
    assert [each.name for each in tmp_path.iterdir()] == ["era.sock.lock"]
    lock.release()


@pytest.mark.parametrize(("folder", "mode"), [(0o750, 0o660), (0o755, 0o600), (0o710, 0o660)])
def test_socket_is_shared_with_group_of_its_folder(tmp_path: Path, folder: int, mode: int) -> None:
    """Only where the folder is closed to others."""
    tmp_path.chmod(folder)
    lock = SocketLock(tmp_path / "era.sock")
    with lock.bind():
        assert lock.path.stat().st_mode & 0o777 == mode
    lock.release()


def test_socket_lock_says_that_a_file_system_has_no_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As over a network; it is no second daemon."""

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", no_locks)
    with pytest.raises(InputError, match=os.strerror(errno.ENOLCK)):
        SocketLock(tmp_path / "era.sock")


def test_full_disk_is_named_by_the_file_that_has_no_room(tmp_path: Path) -> None:
    """Under the socket, and under the dashboard's token."""
    path = tmp_path / "era.sock"
    with full_disk(at=0):
        with pytest.raises(InputError, match=f"{path}.lock"):
            SocketLock(path)
        with pytest.raises(InputError, match="dashboard-token"):
            gateway_options("127.0.0.1:0", path)
    SocketLock(path).release()


@pytest.mark.parametrize("kind", ["link", "pipe", "foreign"])
def test_socket_lock_cannot_be_prepared_by_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """A lock file must be a plain file of this user; others lose access to it."""
    lock = tmp_path / "era.sock.lock"
    match kind:
        case "link":
            lock.symlink_to("elsewhere")
        case "pipe":
            os.mkfifo(lock)
        case _:
            lock.touch(0o644)
            SocketLock(tmp_path / "era.sock").release()
            assert lock.stat().st_mode & 0o777 == 0o600
            monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    with pytest.raises(InputError, match=str(lock)):
        SocketLock(tmp_path / "era.sock")


def test_socket_lock_refuses_folder_that_others_can_write(tmp_path: Path) -> None:
    """Another user could listen there in the daemon's place."""
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(InputError, match=str(folder)):
        SocketLock(folder / "era.sock")


def test_socket_lock_refuses_symbolic_link_of_another_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its owner could redirect it to another folder later; a link of the same user is allowed."""
    (tmp_path / "ours").mkdir()
    link = tmp_path / "link"
    link.symlink_to("ours")
    SocketLock(link / "era.sock").release()
    theirs = os.stat_result((0o120777, *link.lstat()[1:4], os.getuid() + 1, *link.lstat()[5:10]))
    monkeypatch.setattr(Path, "lstat", lambda path: theirs)
    with pytest.raises(InputError, match=str(link)):
        SocketLock(link / "era.sock")


def test_socket_lock_refuses_path_too_long_for_a_socket(tmp_path: Path) -> None:
    """The system's own error would name no length."""
    room = 106 - len(str(tmp_path)) - 1
    with pytest.raises(InputError, match="106 bytes, got 107"):
        SocketLock(tmp_path / ("x" * (room + 1)))
    lock = SocketLock(tmp_path / ("x" * room))
    lock.bind().close()
    lock.release()


@pytest.mark.parametrize("kind", ["file", "folder", "link"])
def test_socket_lock_leaves_other_files_alone(tmp_path: Path, kind: str) -> None:
    """Whatever is no socket is refused before anything is created."""
    path = tmp_path / "there"
    match kind:
        case "file":
            path.write_text("mine", encoding="utf-8")
        case "folder":
            path.mkdir()
        case _:
            path.symlink_to(tmp_path / "nowhere")
    with pytest.raises(InputError, match=str(path)):
        SocketLock(path)
    assert [each.name for each in tmp_path.iterdir()] == ["there"]


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
