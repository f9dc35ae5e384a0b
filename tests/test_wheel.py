"""What is built to be installed: the same every time, complete, nothing besides, and it works.

With the C libraries, and without a compiler. Also from a rig to a design where Python has nothing
of POSIX: a process like on Windows.
"""

import ctypes
import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from configparser import ConfigParser
from pathlib import Path

import pytest
from packaging.tags import platform_tags

from build_libraries import Library, tree_libraries, update
from cases import shortly
from model.compiled.kernels import WITHOUT_KERNELS
from model.compiled.versions import versions
from packages import PACKAGES

ROOT = Path(__file__).parents[1]
LATER = 4_000_000_000  # s; a time of change after those of all files of the project

# Of the sources: what is neither a program nor made by one.
DATA = re.compile(
    r"\.(c|h|pyi?|typed|yaml|csv|json|ahap|haptic|hjif|js|css|html|svg|service|rules|conf|toml)$"
)


def build(target: str, root: Path, folder: Path, **environment: str) -> Path:
    """The wheel or the sdist of the sources in root."""
    command = [sys.executable, "-m", "hatchling", "build", "--target", target, "-d", str(folder)]
    variables = {**os.environ, **environment}
    subprocess.run(command, cwd=root, capture_output=True, check=True, env=variables)
    return next(folder.glob("*.whl" if target == "wheel" else "*.tar.gz"))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the checkout, without a C compiler."""
    return build("wheel", ROOT, tmp_path_factory.mktemp("wheel"), CC="no-such-compiler")


@pytest.fixture(scope="module")
def platform_wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the checkout, with the C libraries."""
    return build("wheel", ROOT, tmp_path_factory.mktemp("platform"))


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the checkout."""
    return build("sdist", ROOT, tmp_path_factory.mktemp("sdist"))


def test_wheel_holds_the_sources_and_their_data(wheel: Path) -> None:
    """Every module, page and data file of the packages, what examples lend, and nothing else.

    Without a compiler, its tag is for every platform.
    """
    assert wheel.stem.endswith("-py3-none-any")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    metadata = {name for name in names if ".dist-info/" in name}
    recordings = {
        f"controller/data/{name}.tuio" for name in ("touches", "two_people", "three_people")
    }
    lent = recordings | {"model/data/paper_plate.yaml"}
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.*")
        if "__pycache__" not in path.parts and path.suffix != ".so"
    }
    assert names - metadata == sources | lent
    assert [name for name in sources if not DATA.search(name)] == []
    assert {f"{package}/py.typed" for package in PACKAGES} <= names
    assert {
        "controller/gateway/page/index.html",
        "controller/gateway/page/app.js",
        "controller/gateway/page/style.css",
    } <= names
    assert {name.partition(".dist-info/")[2] for name in metadata} == {
        "METADATA",
        "RECORD",
        "WHEEL",
        "entry_points.txt",
        "licenses/LICENSE",
    }


def test_entry_points_lead_into_the_wheel(wheel: Path) -> None:
    """The command is a module that it holds; parts of the project need no entry point."""
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        text = next(name for name in names if name.endswith("entry_points.txt"))
        points = ConfigParser(delimiters="=")
        points.read_string(archive.read(text).decode("utf-8"))
    modules = {
        value.partition(":")[0]
        for group in points.sections()
        for value in dict(points[group]).values()
    }
    assert modules == {"era_haptics.command"}
    assert [
        module
        for module in sorted(modules)
        if not names & {f"{module.replace('.', '/')}{end}" for end in (".py", "/__init__.py")}
    ] == []


@pytest.mark.long
@pytest.mark.needs("cc")
def test_sdist_makes_the_same_wheel(platform_wheel: Path, sdist: Path, tmp_path: Path) -> None:
    """Byte for byte, with the same compiler, so a distribution's build equals the published one."""
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path, filter="data")
    root = next(tmp_path.iterdir())
    again = build("wheel", root, tmp_path / "again")
    assert again.name == platform_wheel.name
    assert again.read_bytes() == platform_wheel.read_bytes()


@pytest.mark.long
@pytest.mark.needs("cc")
def test_wheel_of_a_platform_brings_its_libraries(
    wheel: Path, platform_wheel: Path, tmp_path: Path
) -> None:
    """It is tagged for the platform; its libraries are loaded where there is no compiler."""
    python, abi, platform = platform_wheel.stem.split("-")[-3:]
    assert (python, abi) == ("py3", "none")
    assert platform in set(platform_tags())
    assert not platform.startswith("linux_")  # which no package index takes
    with zipfile.ZipFile(platform_wheel) as archive, zipfile.ZipFile(wheel) as plain:
        assert set(archive.namelist()) - set(plain.namelist()) == {
            "sim/soft_amp/sound-engine.so",
            *(f"model/compiled/{version.file}" for version in versions()),
        }
        archive.extractall(tmp_path / "installed")
    done = subprocess.run(
        [
            *(sys.executable, "-c"),
            "from model.compiled.kernels import kernels\n"
            "from sim.soft_amp.engine import library\n"
            "print(kernels().library._name, library()._name)",
        ],
        env={"PYTHONPATH": str(tmp_path / "installed"), "PATH": "", "CC": "no-such-compiler"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    kernels, engine = map(Path, done.stdout.split())
    assert kernels.parent == tmp_path / "installed/model/compiled"
    assert engine == tmp_path / "installed/sim/soft_amp/sound-engine.so"


@pytest.mark.long
@pytest.mark.needs("cc")
def test_editable_installation_gets_the_libraries_of_its_processor(tmp_path: Path) -> None:
    """They are in the tree; the wheel has none, and those of other processors are not compiled."""
    tree = tmp_path / "tree"
    for name in ("model/compiled", "sim/soft_amp", "firmware"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("*.so"))
    for name in ("hatch_build.py", "build_libraries.py"):
        shutil.copy2(ROOT / name, tree)
    program = (
        "import sys; from hatch_build import LibraryHook; data = {'force_include': {}}\n"
        "hook = LibraryHook(sys.argv[1], {}, None, None, '', 'wheel')\n"
        "hook.initialize('editable', data); print(data)"
    )
    command = [sys.executable, "-c", program, str(tree)]
    done = subprocess.run(command, cwd=tree, capture_output=True, text=True, check=True)
    assert done.stdout == "{'force_include': {}}\n"
    compiled = {path.relative_to(tree).as_posix() for path in tree.rglob("*.so")}
    assert compiled == {library.file for library in tree_libraries()}


@pytest.mark.needs("cc")
def test_library_is_compiled_if_its_sources_differ_from_those_it_was_compiled_of(
    tmp_path: Path,
) -> None:
    """Also if an older source file comes back; otherwise the file stays."""
    source, path = tmp_path / "number.c", tmp_path / "number.so"
    library = Library(path.name, (source,), (), ())
    numbers = []
    for number, age in ((7, 0), (8, 60), (7, 0), (7, 0)):
        source.write_text(f"int number(void) {{ return {number}; }}")
        time = LATER + age
        os.utime(source, (time, time))
        update([library], tmp_path)
        loaded = ctypes.CDLL(str(shutil.copy(path, tmp_path / f"{len(numbers)}.so")))
        numbers.append(loaded.number())
    assert numbers == [7, 8, 7, 7]
    compiled = path.stat().st_ino
    update([library], tmp_path)
    assert path.stat().st_ino == compiled


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
from era_haptics.command import main

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
NUMPY = """
import pathlib
import model.compiled.kernels as compiled
compiled.KERNEL_FOLDER = pathlib.Path("nowhere")
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
    ("has_kernels", "work"),
    [
        pytest.param(True, "", id="shown"),
        pytest.param(False, WORK + DESIGN, id="numpy-design", marks=pytest.mark.long),
        pytest.param(True, WORK + DESIGN, id="c-design", marks=pytest.mark.long),
    ],
)
def test_what_needs_no_wire_needs_no_posix(tmp_path: Path, has_kernels: bool, work: str) -> None:
    """A rig and its plate are shown; table, playback and design write files; numpy warns once."""
    program = HIDDEN + ("" if has_kernels else NUMPY) + SHOWN + work
    done = subprocess.run(
        [sys.executable, "-X", "warn_default_encoding", "-c", program, str(RIG)],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PATH": "", "XDG_CACHE_HOME": str(tmp_path / "cache")},
    )
    assert done.returncode == 0, done.stderr
    if not work:
        return
    assert (tmp_path / "t.npz").stat().st_size > 100_000
    assert (tmp_path / "played.png").read_bytes().startswith(b"\x89PNG")
    assert any((tmp_path / "design").iterdir())
    assert done.stderr.count(WITHOUT_KERNELS) == (not has_kernels)


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
