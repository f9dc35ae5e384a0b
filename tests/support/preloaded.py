"""`era`, `python -P -m sim` and programs of the tests, forked off one process that has loaded them.

Loading takes most of the time of a short command, and the suite starts about two hundred. Whoever
starts one of them by `subprocess` or asyncio gets a process as usual: with its pipes, environment
and folder, a child of the caller, with signals and an exit status of its own. Only a `preexec_fn`
needs a start of its own, and gets one. Commands that start such processes themselves get a
process of their own to fork them off.
"""

import atexit
import ctypes
import gc
import inspect
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from importlib import import_module
from io import TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO, cast

ERA = str(Path(sys.executable).with_name("era"))
SIM = [sys.executable, "-P", "-m", "sim"]
CHILD = [sys.executable, "-P", "-m", "controller.daemon.child_main"]
PROGRAMS = {
    (sys.executable, str(Path(__file__).with_name(name)))
    for name in (
        "interrupted.py",
        "live_demonstration.py",
        "patient_daemon.py",
        "steady_host.py",
    )
}
"""Programs of the tests that do with `era` what no user can."""
_PARENTS = ("daemon", "live_demonstration.py", "planted_daemon.py")
"""Commands and programs that start others."""
_LOADED = (
    "controller.daemon.child_main",
    "controller.daemon.config_reader",
    "controller.daemon.run",
    "controller.gateway.serving",
    "model.commands.options",
    "model.fem.plate",
    "model.design.run",
    "model.table.build",
    "scipy.ndimage",
    "sim.memory_line",
    "sim.process.simulation",
    "typer._adapters",
)
"""Modules that commands load when they run."""
_PR_SET_CHILD_SUBREAPER = 36  # prctl(2)
_SIZE = 8  # bytes of the length of a request

_execute_child: Any = subprocess.Popen._execute_child


class Loaded:
    """The process that has loaded everything; started when it is first needed."""

    def __init__(self, connection: socket.socket | None = None) -> None:
        self._socket = connection
        self._process: subprocess.Popen[bytes] | None = None
        self._turn = threading.Lock()

    def start(
        self, arguments: Sequence[str], folder: str, environment: Mapping[str, str],
        files: Sequence[int], *, new_session: bool,
    ) -> int:  # fmt: skip
        """Fork a child off it, with these three standard files; return its process id."""
        connection = self._connected()
        request = json.dumps([arguments, folder, dict(environment), new_session]).encode()
        with self._turn:
            # The child is a grandchild of that process: an orphan, and so a child of this one.
            _adopt_orphans(True)
            try:
                socket.send_fds(connection, [len(request).to_bytes(_SIZE, "big")], files)
                connection.sendall(request)
                return int.from_bytes(connection.recv(_SIZE), "big")
            finally:
                _adopt_orphans(False)

    def close(self) -> None:
        """End it; those that it has started go on."""
        if self._socket is not None and self._process is not None:
            self._socket.close()
            self._process.wait()

    def _connected(self) -> socket.socket:
        if self._socket is None:
            self._socket, theirs = socket.socketpair()
            with theirs:
                command = [sys.executable, "-P", __file__]
                self._process = subprocess.Popen(command, stdin=theirs, start_new_session=True)
        return self._socket


def install(connection: socket.socket | None = None) -> Loaded:
    """Fork `era` and `sim` off a loaded process from now on, the one at a connection if given."""
    loaded = Loaded(connection)
    signature = inspect.signature(_execute_child)

    def execute_child(popen: Any, *arguments: Any) -> None:
        named = signature.bind(popen, *arguments).arguments
        words = named["args"]
        if named["preexec_fn"] or not _is_known(words):
            _execute_child(popen, *arguments)
            return
        ends = (named["p2cread"], named["c2pwrite"], named["errwrite"])
        popen.pid = loaded.start(
            [os.fsdecode(word) for word in words],
            os.fsdecode(named["cwd"] or Path.cwd()),
            os.environ if named["env"] is None else named["env"],
            [number if end == -1 else end for number, end in enumerate(ends)],
            new_session=named["start_new_session"],
        )
        popen._child_created = True
        popen._close_pipe_fds(*(named[name] for name in _PIPES))

    subprocess.Popen._execute_child = execute_child
    return loaded


_PIPES = ("p2cread", "p2cwrite", "c2pread", "c2pwrite", "errread", "errwrite")


def _is_known(words: Any) -> bool:
    if not isinstance(words, list | tuple):
        return False
    return (
        str(words[0]) == ERA
        or [str(word) for word in words[:4]] in (SIM, CHILD)
        or tuple(str(word) for word in words[:2]) in PROGRAMS
    )


def _adopt_orphans(adopts: bool) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(adopts), 0, 0, 0)


def _serve(connection: socket.socket) -> list[str]:
    """Fork children until the connection ends; return in a child, with its words."""
    while True:
        size, files, _, _ = socket.recv_fds(connection, _SIZE, 3)
        if not size:
            os._exit(0)
        request = b""
        while len(request) < int.from_bytes(size, "big"):
            request += connection.recv(1 << 20)
        reading, writing = os.pipe()
        if not (between := os.fork()):
            between = os.getpid()
            if not (child := os.fork()):
                while os.getppid() == between:  # its parent is the caller, as it may check
                    time.sleep(0.001)
                os.close(reading)
                os.close(writing)
                words, *where = json.loads(request)
                connection.detach()  # its number is that of a child's standard input
                _settle(files, *where)
                return cast(list[str], words)
            os.write(writing, child.to_bytes(_SIZE, "big"))
            os._exit(0)
        os.waitpid(between, 0)
        connection.sendall(os.read(reading, _SIZE))
        for file in (reading, writing, *files):
            os.close(file)


def _settle(files: list[int], folder: str, environment: dict[str, str], new_session: bool) -> None:
    """Take the place, the environment and the standard files of a child."""
    if new_session:
        os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, file in enumerate(files):
        os.dup2(file, number)
    os.closerange(3, max(files) + 1)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    places = environment.get("PYTHONPATH", "").split(":")
    sys.path[:0] = [place for place in places if place and place not in sys.path]
    through = bool(environment.get("PYTHONUNBUFFERED"))
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115
    for name, number in (("stdout", 1), ("stderr", 2)):
        file = cast(BinaryIO, open(number, "wb", closefd=False))  # noqa: SIM115
        buffered = not (through or number == 2 or file.isatty())
        setattr(sys, name, TextIOWrapper(file, "utf-8", write_through=through))
        getattr(sys, name).reconfigure(line_buffering=not buffered)
        setattr(sys, f"__{name}__", getattr(sys, name))  # kept where a program replaces it


def _load() -> None:
    """Load what any of them needs."""
    from controller.cli.main import load_commands

    load_commands()
    for name in _LOADED:
        import_module(name)
    gc.collect()
    gc.freeze()


def _end(status: object) -> None:
    """End a child as usual, but leave what was loaded before it whole: that takes most of the time.

    Of what the command has made itself, garbage is collected, with the warnings that come of it.
    """
    if not isinstance(status, int):
        return  # None or a text: as usual
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    gc.collect()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except OSError:
        return  # so that Python says so
    os._exit(status & 0xFF)


def main() -> int:
    """Serve; in a child, run its command."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _load()
    words = _serve(socket.socket(fileno=0))
    while not {Path(word).name for word in words[:2]}.isdisjoint(_PARENTS):
        connection = _branch()
        if connection is None:
            break
        words = _serve(connection)
    try:
        status = _run(words)
    except SystemExit as end:
        _end(end.code)
        raise
    _end(status)
    return status


def _branch() -> socket.socket | None:
    """Fork a process off which this one forks others; return its end of the connection there."""
    ours, theirs = socket.socketpair()
    if os.fork():
        theirs.close()
        install(ours)
        return None
    ours.close()
    os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    null = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(null, number)
    os.close(null)
    return theirs


def _run(words: list[str]) -> int:
    """Run a command in a child."""
    if words[0] == ERA:
        sys.argv = words
        from controller.cli.main import main as era

        return era()
    if words[: len(SIM)] == SIM:
        sys.argv = [words[0], *words[len(SIM) :]]
        from sim.__main__ import main as sim

        return sim()
    if words[: len(CHILD)] == CHILD:
        sys.argv = words[len(CHILD) - 1 :]
        from controller.daemon.child_main import _main as child

        sys.modules.pop(sys.argv[2], None)  # or runpy warns
        child()
        return 0
    sys.argv = words[1:]
    sys.path.insert(0, str(Path(__file__).parent))
    runpy.run_path(words[1], run_name="__main__")
    return 0


if __name__ == "__main__":
    sys.exit(main())
