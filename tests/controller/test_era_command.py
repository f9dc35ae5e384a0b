"""The `era` command with its exit statuses, and what a daemon's process needs.

The socket reserved for one daemon, its log, notices to systemd and latencies; none may block it.
"""

import errno
import io
import json
import logging
import os
import pty
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from textwrap import dedent
from unittest.mock import Mock

import pytest

from controller.cli.daemon_cli import position_on
from controller.daemon.children import gateway_options
from controller.process.daemon_process import SocketLock
from controller.process.log import LogFormatter, LogThread, RateLimitFilter
from model.errors import InputError
from processes.gateways import wait_for
from processes.installed import installed_program
from processes.interrupted import full_disk
from registry.command_line import LoadModules, run
from registry.service_manager import ServiceManager


@pytest.mark.parametrize(
    ("folder", "mode"), [(None, 0o600), (0o750, 0o660), (0o755, 0o600), (0o710, 0o660)]
)
def test_socket_is_for_its_user_and_the_group_of_its_folder_only(
    tmp_path: Path, folder: int | None, mode: int
) -> None:
    """For the group where the folder is closed to others; a new folder has mode 0700.

    Whatever the umask, which stays; removed at the end.
    """
    mask, path = os.umask(0), tmp_path / "new" / "era.sock"
    try:
        if folder is not None:
            path.parent.mkdir()
            path.parent.chmod(folder)
        lock = SocketLock(path)
        with lock.bind():
            assert path.stat().st_mode & 0o777 == mode
            assert path.with_name("era.sock.lock").stat().st_mode & 0o777 == 0o600
            assert path.parent.stat().st_mode & 0o777 == (folder or 0o700)
        assert os.umask(0) == 0
        lock.release()
        assert not path.exists()
    finally:
        os.umask(mask)


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
    assert [entry.name for entry in tmp_path.iterdir()] == ["era.sock.lock"]


def test_socket_that_cannot_be_locked_or_listen_is_no_second_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file system without locks, as over a network, is named; a socket leaves no file.

    Neither under its name nor under the one before.
    """
    path = tmp_path / "era.sock"
    with monkeypatch.context() as patched:
        refused = OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
        patched.setattr("fcntl.flock", Mock(side_effect=refused))
        with pytest.raises(InputError, match=os.strerror(errno.ENOLCK)):
            SocketLock(path)
    deaf = type("Deaf", (socket.socket,), {"listen": Mock(side_effect=OSError(98, "in use"))})
    lock = SocketLock(path)
    monkeypatch.setattr(socket, "socket", deaf)
    with pytest.raises(InputError, match="in use"):
        lock.bind()
    assert [entry.name for entry in tmp_path.iterdir()] == ["era.sock.lock"]
    lock.release()


def test_touch_moves_a_finger_at_constant_speed_along_its_points() -> None:
    """Halfway along 3 m and then 4 m at a right angle, a finger is 0.5 m into the second line."""
    path = [(0.0, 0.0), (3.0, 0.0), (3.0, 4.0)]
    assert position_on(path, 0.5) == pytest.approx((3.0, 0.5))
    assert position_on(path, 0.0) == (0.0, 0.0)
    assert position_on(path, 1.0) == (3.0, 4.0)
    assert position_on(path[:1], 0.5) == (0.0, 0.0)


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


def test_socket_lock_refuses_folders_that_others_can_change_and_long_paths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another user could listen in a folder open to all, or redirect a link of his to another.

    A link of the same user is allowed. The system's own error would name no length of a path.
    """
    room = 106 - len(str(tmp_path)) - 1
    with pytest.raises(InputError, match="106 bytes, got 107"):
        SocketLock(tmp_path / ("x" * (room + 1)))
    lock = SocketLock(tmp_path / ("x" * room))
    lock.bind().close()
    lock.release()
    link, open_to_all = tmp_path / "link", tmp_path / "open"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    with pytest.raises(InputError, match=str(open_to_all)):
        SocketLock(open_to_all / "era.sock")
    (tmp_path / "ours").mkdir()
    link.symlink_to("ours")
    SocketLock(link / "era.sock").release()
    theirs = os.stat_result((0o120777, *link.lstat()[1:4], os.getuid() + 1, *link.lstat()[5:10]))
    monkeypatch.setattr(Path, "lstat", lambda path: theirs)
    with pytest.raises(InputError, match=str(link)):
        SocketLock(link / "era.sock")


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
def entries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LoadModules:
    """A module with commands, which is forgotten after the test."""
    (tmp_path / f"{MODULE}.py").write_text(dedent(COMMANDS), encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, MODULE, raising=False)
    return lambda: [import_module(MODULE)]


def run_typed(folder: Path, *arguments: str, **environment: str) -> "subprocess.Popen[str]":
    """A process that runs the test commands, which are written to a folder."""
    (folder / f"{MODULE}.py").write_text(dedent(COMMANDS), encoding="utf-8")
    script = (
        "import importlib, registry.command_line as m\n"
        f"raise SystemExit(m.main(lambda: [importlib.import_module({MODULE!r})]))"
    )
    return subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        env={**os.environ, "PYTHONPATH": str(folder), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_run_runs_a_command_and_returns_zero(
    entries: LoadModules, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commands and groups of a package are at the root, with their options; so are help, version.

    Without a command the help is shown as it is, not as an error message. The program is called era
    however it was started; by some services with a closed standard output, for which Python has
    None.
    """
    assert run(["good", "--number", "5"], entries) == 0
    assert run(["parts", "list"], entries) == 0
    written = capsys.readouterr()
    assert written.out.startswith("number 5 ")
    assert written.out.endswith("none\n")
    assert written.err == ""
    for arguments in ([], ["parts"]):
        assert run(arguments, entries) == 2
        assert capsys.readouterr().err.startswith("Usage: era")
    assert run(["--version"], entries) == 0
    assert capsys.readouterr().out == f"era-haptics {version('era-haptics')}\n"
    assert run(["--help"], entries) == 0
    text = capsys.readouterr().out
    assert text.startswith("Usage: era ")
    for word in ("good", "ends", "parts", "--version", "--debug"):
        assert word in text
    monkeypatch.setattr("sys.stdout", None)
    assert run(["--version"], entries) == 0


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (["ends", "refused"], 1, ""),
        (["ends", "worse"], 2, "rig.yaml:3: plate.length: is missing; add it"),
        (["ends", "unplugged"], 3, "the line is gone; plug it in"),
        pytest.param(
            ["ends", "file"], 2, "/no/such/file: no such folder /no/such", id="missing folder"
        ),
        pytest.param(["ends", "bug"], 70, "KeyError: 'oops'", id="bug"),
        pytest.param(
            ["ends", "--", "--debug"], 70, "KeyError: '--debug'", id="debug behind two dashes"
        ),
        (["ends", "interrupt"], 130, ""),
        (["ends", "abort"], 130, ""),
        (["god"], 2, "Did you mean 'good'? See era --help"),
        pytest.param(
            ["version"], 2, "Did you mean --version? See era --help", id="option without dashes"
        ),
        (["good", "--nmber", "1"], 2, "era good --help"),
        (["good", "--number", "x"], 2, "era good --help"),
        (["ends"], 2, "era ends --help"),
        (["parts", "lst"], 2, "era parts --help"),
        (["--wrong"], 2, "era --help"),
    ],
)
def test_run_reports_an_error_in_one_line_with_its_status(
    entries: LoadModules,
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


@pytest.mark.parametrize(
    "arguments",
    [["--debug", "ends", "bug"], ["ends", "--debug", "bug"], ["ends", "bug", "--debug"]],
    ids=["first", "in between", "last"],
)
def test_run_shows_the_traceback_with_debug(
    entries: LoadModules, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    """The option is accepted anywhere; the traceback has no colour."""
    assert run(arguments, entries) == 70
    written = capsys.readouterr()
    assert "Traceback (most recent call last):" in written.err
    assert "\x1b" not in written.err


def test_main_ends_quietly_and_prints_what_its_output_cannot_encode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Quietly when its reader closes, as in `era ... | head`.

    Escaped: a unit in an output of ASCII, and the name of a file that is not UTF-8. Before any
    command is loaded it limits linear algebra to one thread, unless the user has chosen.
    """
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    with run_typed(tmp_path, "flood") as flood:
        assert flood.stdout.readline() == "line 0\n"
        flood.stdout.close()
        assert flood.stderr.read() == ""
        assert flood.wait() == 141
    for command, printed, output in (
        ("letters", {"PYTHONIOENCODING": "ascii"}, "m/s\\xb2 p\\udcfc\n"),
        ("good", {}, "number 1 1\n"),
        ("good", {"OMP_NUM_THREADS": "7"}, "number 1 7\n"),
    ):
        with run_typed(tmp_path, command, **printed) as done:
            assert done.communicate()[0] == output
            assert done.returncode == 0


@pytest.mark.parametrize(
    ("typed", "words"),
    [("era con", {"config", "content"}), ("era content check tick --qu", {"--quiet"})],
)
def test_bash_completes_commands_and_options(typed: str, words: set[str]) -> None:
    """By the script that `era --show-completion` prints for the shell that runs it."""
    *earlier_words, last = typed.split()
    script = (
        'script=$(era --show-completion) && eval "$script" && '
        f"COMP_WORDS=({typed}) COMP_CWORD={len(earlier_words)} && "
        f"_era_completion era {last} {earlier_words[-1]} "
        '&& echo "${COMPREPLY[@]}"'
    )
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        ["bash", "--norc", "-c", script],
        capture_output=True,
        text=True,
        env=os.environ | {"PATH": path},
        timeout=60,
    )
    assert done.stderr == ""
    assert {*done.stdout.split()} == words


def install_completion(shell: str, home: Path) -> dict[str, str]:
    """Run `era --install-completion` in a shell with a home of its own; return its environment."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = os.environ | {"HOME": str(home), "PATH": path, "TERM": "xterm"}
    for name in ("ZDOTDIR", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        environment.pop(name, None)
    command = [installed_program(shell), "-c", "era --install-completion; true"]
    installed = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60)
    assert f"{shell} completion installed in {home}" in installed.stdout
    return environment


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        pytest.param("era con", {"config", "content"}, marks=pytest.mark.long),
        ("era content check tick --qu", {"--quiet"}),
    ],
)
def test_fish_completes_commands_and_options(tmp_path: Path, typed: str, words: set[str]) -> None:
    """After `era --install-completion`, by fish's own list of completions with descriptions."""
    environment = install_completion("fish", tmp_path)
    done = subprocess.run(
        ["fish", "-c", f"complete -C '{typed}'"],
        capture_output=True,
        text=True,
        env=environment,
        timeout=60,
    )
    assert {line.split("\t")[0] for line in done.stdout.splitlines()} == words


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("era conf\t", "ig"),
        pytest.param("era content check tick --qu\t", "iet", marks=pytest.mark.long),
    ],
)
def test_zsh_completes_commands_and_options(tmp_path: Path, typed: str, completed: str) -> None:
    """After `era --install-completion`, typed with Tab in an interactive zsh on a terminal.

    The first Tab of a session loads Typer's script and completes nothing.
    """
    environment = install_completion("zsh", tmp_path)
    ours, theirs = pty.openpty()
    shell = subprocess.Popen(
        ["zsh", "-i"], stdin=theirs, stdout=theirs, stderr=theirs, env=environment
    )
    os.close(theirs)
    try:
        read_until(ours, "\x1b[?2004h")  # the prompt accepts input
        os.write(ours, typed.encode())
        read_until(ours, "\a")  # the bell: nothing completed
        os.write(ours, b"\t")
        read_until(ours, completed)
    finally:
        shell.kill()
        shell.wait()
        os.close(ours)


def read_until(terminal: int, expected: str, *, patience: float = 60) -> None:
    """Read from a terminal until it has shown a text."""
    shown = ""
    deadline = time.monotonic() + patience
    while expected not in shown:
        ready, _, _ = select.select([terminal], [], [], max(deadline - time.monotonic(), 0))
        assert ready, f"{expected!r} was not shown: {shown!r}"
        shown += os.read(terminal, 4096).decode()


def record(message: str, line: int = 1, **extra: object) -> logging.LogRecord:
    """A record of a logging call at a line."""
    log_record = logging.LogRecord("era.x", logging.WARNING, "/x.py", line, message, (), None)
    log_record.__dict__.update(extra)
    return log_record


def test_log_lines_cannot_be_forged_and_are_bounded() -> None:
    """Any text stays inside one JSON string of printable ASCII, and a long message is cut."""
    evil = 'x\n{"level":"info","message":"all is well"}\r\x1b[2J\x00\u2028"'
    line = LogFormatter().format(record(evil, cause=evil))
    assert line.isascii()
    assert line.isprintable()
    fields = json.loads(line)
    assert (fields["message"], fields["cause"], fields["level"]) == (evil, evil, "warning")
    assert len(LogFormatter().format(record("x" * 10**6))) < 10_000


def test_log_line_has_the_keys_of_its_page() -> None:
    """Time in UTC with milliseconds, level, logger, message, what a call adds, and a traceback."""
    log_record = record("link: %s", cause=OSError("gone"), remedy=None, skipped=3)
    log_record.args = ("lost",)
    log_record.created, log_record.msecs = 1_000_000_000.25, 250.0
    expected = {"time": "2001-09-09T01:46:40.250Z", "level": "warning", "logger": "era.x"}
    extra = {"message": "link: lost", "cause": "gone", "remedy": None, "skipped": 3}
    assert json.loads(LogFormatter().format(log_record)) == {**expected, **extra}
    try:
        raise ValueError("x" * 10**5)
    except ValueError:
        log_record.exc_info = sys.exc_info()
    fields = json.loads(LogFormatter().format(log_record))
    assert fields.keys() - expected.keys() - extra.keys() == {"traceback"}
    assert fields["traceback"] == "x" * 8000


def test_log_limits_rate_of_each_call_except_state_changes() -> None:
    """Five lines at once, then one a second with the number skipped; transitions are unlimited."""
    now = 0.0
    limit = RateLimitFilter(clock=lambda: now)
    assert sum(limit.filter(record("again")) for _ in range(1000)) == 5
    assert limit.filter(record("another call", line=2))
    now = 1.0
    allowed = record("again")
    assert limit.filter(allowed)
    assert allowed.__dict__["skipped"] == 995
    assert not limit.filter(record("again"))
    transition = record("READY -> ON")
    transition.__dict__["topic"] = "state"
    assert [limit.filter(transition) for _ in range(1000)] == [True] * 1000


@pytest.fixture
def logger() -> Iterator[logging.Logger]:
    """A logger without handlers."""
    log = logging.getLogger("era.test_daemon_log")
    log.propagate = False
    yield log
    log.handlers.clear()


@contextmanager
def logging_to(logger: logging.Logger, file: Path | None) -> Iterator[LogThread]:
    """A thread that writes what is logged to a file, or on the standard error."""
    thread = LogThread(file)
    logger.addHandler(thread)
    yield thread
    thread.close()


def lines_of(file: Path) -> list[str]:
    """The messages of a log."""
    return [json.loads(line)["message"] for line in file.read_text("utf-8").splitlines()]


def test_log_does_not_block_while_disk_hangs(
    logger: logging.Logger, monkeypatch: pytest.MonkeyPatch
) -> None:
    """During a write that does not return, lines are queued up to a bound; clients get them all."""
    hangs, released = threading.Event(), threading.Event()

    class Hanging(io.StringIO):
        def write(self, text: str, /) -> int:
            hangs.set()
            released.wait(20)
            return len(text)

    monkeypatch.setattr(sys, "stderr", Hanging())
    with logging_to(logger, None) as thread:
        thread.subscriber = heard = Mock()
        logger.warning("first")
        assert hangs.wait(20)
        for _ in range(3000):
            logger.warning("more")
        assert thread.queue.qsize() == 2000
        assert heard.call_count == 3001
    released.set()
    wait_for(lambda: not thread.queue.unfinished_tasks)  # or they go to the real standard error


def test_full_disk_cuts_no_line_of_the_log(logger: logging.Logger, tmp_path: Path) -> None:
    """Each line is in the file as a whole or not at all, and a later one follows a whole one.

    A subscriber gets all records from info on.
    """
    logger.setLevel(logging.DEBUG)
    messages = [f"{number} {'x' * 300}" for number in range(5)]
    heard: list[str] = []
    with logging_to(logger, tmp_path / "log") as thread:
        thread.subscriber = lambda record: heard.append(record.getMessage())
        with full_disk(at=1024):  # bytes, amid the third line
            for message in messages:
                logger.debug(message)
            wait_for(lambda: not thread.queue.unfinished_tasks)
        logger.info("after")
    assert heard == ["after"]
    assert lines_of(tmp_path / "log") == [*messages[:2], "after"]


def test_log_is_reopened_after_rotation_and_once_its_folder_is_there(
    logger: logging.Logger, tmp_path: Path
) -> None:
    """Where the folder of its file is missing for a while, what is logged meanwhile is lost.

    Lines after a rotation are in a new file, which only its owner may read.
    """
    file, rotated = tmp_path / "later" / "log", tmp_path / "log.1"
    with logging_to(logger, file) as thread:
        logger.warning("lost")
        wait_for(lambda: not thread.queue.unfinished_tasks)
        file.parent.mkdir()
        logger.warning("before")
        wait_for(lambda: file.exists() and file.read_text("utf-8"))
        file.rename(rotated)
        logger.warning("after")
    assert (lines_of(rotated), lines_of(file)) == (["before"], ["after"])
    assert file.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("more", "count"),
    [
        ({"WATCHDOG_USEC": "2000000"}, 4),  # at 0, 1, 2 and 3 s
        ({}, 0),
        ({"WATCHDOG_USEC": "x"}, 0),
        ({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}, 0),
    ],
)
def test_service_manager_is_told_and_its_watchdog_fed_at_twice_its_rate(
    more: dict[str, str], count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not one of another process, nor without a valid interval; no assignment can be forged.

    Fed when no descriptor is left, too. Neither a missing variable nor a missing socket is an
    error.
    """
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(path)
        bound.settimeout(60)
        for environment in (
            {},
            {"NOTIFY_SOCKET": "/nowhere/at/all"},
            {"NOTIFY_SOCKET": path, **more},
        ):
            with closing(ServiceManager(environment)) as manager, monkeypatch.context() as patched:
                no_descriptor = Mock(side_effect=OSError(errno.EMFILE, "too many"))
                patched.setattr(socket, "socket", no_descriptor)
                manager.ready("all is well\nERRNO=5")
                for milliseconds in range(0, 3500, 50):
                    manager.alive(milliseconds / 1000)
                manager.notify("STOPPING=1")
        assert bound.recv(4096).startswith(b"READY=1\nSTATUS=all is wellERRNO=5")
        messages = []
        while (message := bound.recv(100)) != b"STOPPING=1":
            messages.append(message)
        assert messages == [b"WATCHDOG=1"] * count
