"""From a rig to a design where Python has nothing of POSIX: a process like on Windows."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from long_form import shortly

RIG = Path(__file__).parents[1] / "examples" / "paper_plate.yaml"

HIDDEN = '''
import os, select, signal, socket, sys, warnings
import multiprocessing, platformdirs, serial, subprocess  # which choose by the system

class Hidden:
    """Finds no module of POSIX systems."""
    NAMES = ("crypt", "fcntl", "grp", "nis", "pty", "pwd", "resource", "syslog", "termios", "tty")
    def find_spec(self, name, path=None, target=None):
        if name in self.NAMES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

for name in Hidden.NAMES:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Hidden())
for module, names in {
    os: "chown fchmod fchown fork forkpty getegid geteuid getgid getloadavg getpgid getuid killpg "
    "lockf mkfifo nice O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NONBLOCK O_SYNC openpty pipe2 "
    "posix_fallocate sched_getaffinity sched_setaffinity setpriority setsid statvfs",
    select: "epoll poll",
    signal: "SIGALRM SIGHUP SIGKILL SIGPIPE SIGQUIT SIGTSTP SIGUSR1 SIGUSR2 pthread_sigmask",
    socket: "SOCK_CLOEXEC SOCK_NONBLOCK",
}.items():
    for name in names.split():
        delattr(module, name)
OURS = r"(controller|drivers|era_haptics|model|registry|sim)\\."
warnings.filterwarnings("error", category=EncodingWarning, module=OURS)
from controller.cli.main import main

def era(*arguments):
    """Run a command; its exit status."""
    sys.argv[1:] = arguments
    return main()
'''

SHOWN = """
import era_haptics as notebook
RIG = sys.argv[1]
assert era("config", "check", RIG) == 0
assert era("plate", "show", RIG) == 0
assert era("amp", "status", f"sim://{RIG}") == 0
"""
WORK = """
assert era("table", "build", RIG, "--mesh", "11x9", "--output", "t.npz") == 0
assert era("table", "query", "t.npz", "--target", "0.08,0.06", "--quiet", "0.22,0.16") == 0
rig = notebook.load_rig(RIG, mesh="11x9")
table = notebook.load_table("t.npz", rig=rig)
only = notebook.query(table, (0.08, 0.06), quiet=[(0.22, 0.16)])
played = notebook.SolvedPlate(rig).play(only, (0.08, 0.06), quiet=[(0.22, 0.16)])
notebook.draw_playback(played).savefig("played.png")
"""
DESIGN = """
assert era("design", RIG, "--mesh", "11x9", "--layouts", "random:1", "--finalists", "1",
           "--workers", "1", "--output", "design") == 0
"""


@pytest.mark.parametrize(
    ("compiler", "work"),
    [
        pytest.param("", "", id="shown"),
        pytest.param("", WORK + DESIGN, id="numpy-design", marks=pytest.mark.long),
        pytest.param(os.environ["PATH"], WORK + DESIGN, id="c-design", marks=pytest.mark.long),
    ],
)
def test_what_needs_no_wire_needs_no_posix(tmp_path: Path, compiler: str, work: str) -> None:
    """A rig and its plate are shown; table, playback and design write files; numpy warns once."""
    done = subprocess.run(
        [sys.executable, "-X", "warn_default_encoding", "-c", HIDDEN + SHOWN + work, str(RIG)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PATH": compiler, "XDG_CACHE_HOME": str(tmp_path / "cache")},
    )
    assert done.returncode == 0, done.stderr
    if not work:
        return
    assert (tmp_path / "t.npz").stat().st_size > 100_000
    assert (tmp_path / "played.png").read_bytes().startswith(b"\x89PNG")
    assert any((tmp_path / "design").iterdir())
    assert done.stderr.count("there is no C compiler") == (not compiler)
    assert any((tmp_path / "cache").rglob("kernels-*.so")) == bool(compiler)


@pytest.mark.parametrize("command", shortly(["status", "sim rig.yaml --serial"], ["status"]))
def test_what_needs_posix_says_so(tmp_path: Path, command: str) -> None:
    """One sentence with what to do, as for other invalid input; a notebook's client likewise."""
    (tmp_path / "rig.yaml").write_bytes(RIG.read_bytes())
    program = f"{HIDDEN}\nimport era_haptics\ntry: era_haptics.Client\n"
    program += f"except ImportError as error: print(error)\nsys.exit(era(*{command.split()}))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("era: error: wires, daemon and clients need Linux or macOS")
    assert (
        done.stdout
        == "wires, daemon and clients need Linux or macOS (no module pwd here); use WSL\n"
    )
