"""The wheel alone, in clean environments: does it work, and what does it weigh?

    python tests/programs/smoke.py WHEEL [--python PYTHON ...] [--lowest]

Each Python that is found gets an environment with nothing but the wheel and what it needs, then its
extra `gateway`; what a user types first must work in an empty folder. Prints a row for each Python;
exit status 1 where something failed or none was found. --lowest: with the lowest version that each
bound in the wheel allows.
"""

import argparse
import contextlib
import importlib.metadata
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from email.parser import HeaderParser
from pathlib import Path

from packaging.requirements import Requirement
from websockets.sync.client import connect
from websockets.typing import Subprotocol

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from packages import PACKAGES

PYTHONS = ("python3.11", "python3.12", "python3.13", "python3.14")
REPEATS = 11
HEAD = (
    "| Python | distributions | MB installed | MB of era-haptics | era --help "
    "| a notebook's imports |\n"
    "|---|---|---|---|---|---|"
)
_USED = "from era_haptics import SolvedPlate, load_rig, query, table"


@dataclass(frozen=True)
class Weight:
    """What an installation weighs [bytes, with compiled modules], and how quickly it starts [s].

    distributions: how many there are, ours among them. help: `era --help`; imported: what a
    notebook imports first; each the median of REPEATS, of the whole process.
    """

    total: int
    ours: int
    distributions: int
    help: float
    imported: float
    bare: float


_TOKEN = "a-token-of-the-smoke-test"
PATIENCE = 120.0  # s; on a machine that is busy with other things


class Failed(AssertionError):
    """A command of the installed distribution did not do what it is for."""


@dataclass(frozen=True)
class InstalledEra:
    """The interpreter of an environment, beside which `era` lies, and where its commands run."""

    python: Path
    folder: Path

    def __call__(self, *arguments: str) -> str:
        """What `era` prints with these arguments; raises Failed where it does not end well."""
        return self._run(str(self.python.with_name("era")), *arguments)

    def module(self, *arguments: str) -> str:
        """What `python -m` prints with these arguments."""
        return self._run(str(self.python), "-m", *arguments)

    def script(self, text: str) -> str:
        """What a program prints."""
        return self._run(str(self.python), "-c", text).strip()

    @contextlib.contextmanager
    def running(self, *arguments: str) -> Iterator[subprocess.Popen[str]]:
        """Run an `era` until the end of the block, where it is terminated."""
        with subprocess.Popen(
            [self.python.with_name("era"), *arguments],
            cwd=self.folder,
            env=self._environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        ) as process:
            try:
                yield process
            finally:
                process.terminate()
                process.wait(PATIENCE)

    def _run(self, *command: str) -> str:
        done = subprocess.run(
            command,
            cwd=self.folder,
            env=self._environment(),
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
        if done.returncode != 0:
            raise Failed(f"{' '.join(command)}: {done.returncode}\n{done.stdout}{done.stderr}")
        return done.stdout

    def _environment(self) -> dict[str, str]:
        """That of the caller, without what leads to another Python or to the user's own files."""
        variables = {
            name: value for name, value in os.environ.items() if not name.startswith("PYTHON")
        }
        places = {"XDG_CACHE_HOME": "cache", "XDG_RUNTIME_DIR": "run"}
        return variables | {name: str(self.folder / place) for name, place in places.items()}


def try_first(era: InstalledEra) -> None:
    """Help, the example rig, and its plate's modes."""
    expect("Usage: era " in era("--help"), "help")
    era("config", "init", "rig.yaml")
    modes = json.loads(era("plate", "modes", "rig.yaml", "-n", "6", "--json"))
    expect(modes["frequencies_hz"] == sorted(modes["frequencies_hz"]), "modes out of order")


def try_files(era: InstalledEra) -> None:
    """Configuration files, a small table, a picture, a bug report; after `try_first`."""
    for kind in ("layout", "daemon"):
        era("config", "init", "--kind", kind, f"{kind}.yaml")
    for kind in ("rig", "layout", "daemon"):
        expect("good" in era("config", "check", f"{kind}.yaml"), f"the example of a {kind} is bad")
    coarse = ("--frequencies", "100:200:50", "--grid", "4x3", "--mesh", "12x9")
    era("table", "build", "rig.yaml", "-o", "small.npz", *coarse)
    fingers = ("--target", "0.06,0.05", "--quiet", "0.2,0.1")
    answer = json.loads(era("table", "query", "small.npz", *fingers, "--json"))
    expect(
        answer["fingers"][0]["contrast_db"] > 6.0, f"the two fingers are not told apart: {answer}"
    )
    era("plate", "map", "rig.yaml", "--drive", "SW=110", "--points", "12x9", "-o", "map.png")
    expect((era.folder / "map.png").stat().st_size > 1000, "no picture")


def try_wire(era: InstalledEra) -> None:
    """A simulated amplifier on a pseudo-terminal, and what is asked of it by hand."""
    with era.running("sim", "rig.yaml", "--serial") as sim:
        name, _, url = sim.stdout.readline().strip().partition(": ")
        expect(name == "main" and url.startswith("serial:"), f"not an amplifier: {name} {url}")
        expect("4" in era("amp", "identify", url), "an amplifier without channels")
        tone = ("--channel", "0", "--frequency", "110", "--level", "0.2", "--for", "0.2")
        era("amp", "drive", url, *tone)
        era("amp", "stop", url)


def try_demo(era: InstalledEra) -> None:
    """The demonstration: the recorded touches that come with it are felt as promised."""
    demo = json.loads(era("demo", "--out", "demo", "--json"))
    pairs = [
        (touch["promised_contrast_db"], touch["measured_contrast_db"])
        for touch in demo["touches"]
        if touch["steady"] and touch["promised_contrast_db"] is not None
    ]
    expect(len(pairs) > 5, "hardly a touch with others on the plate")
    count = sum(promised <= felt for promised, felt in pairs)
    expect(count >= 0.7 * len(pairs), f"not as promised: {pairs}")
    expect(all((era.folder / name).is_file() for name in demo["files"]), "pictures are missing")


def try_gateway(era: InstalledEra) -> None:
    """A daemon and its page; needs the extra `gateway`."""
    (era.folder / "panel.yaml").write_text("rig: rig.yaml\ntable: small.npz\n", encoding="utf-8")
    (era.folder / "token").touch(mode=0o600)
    (era.folder / "token").write_text(f"{_TOKEN}\n", encoding="utf-8")
    listening = ("gateway", "--listen", "127.0.0.1:0", "--token-file", "token")
    with era.running("daemon", "panel.yaml"), era.running(*listening) as gateway:
        url = gateway.stdout.readline().split()[1]
        for name, text in (("", b"<html"), ("app.js", b"import")):
            with urllib.request.urlopen(f"{url}{name}", timeout=PATIENCE) as page:
                expect(text in page.read(), f"no page {name}")
        protocols = [Subprotocol("era-haptics.v1"), Subprotocol(f"era-haptics.token.{_TOKEN}")]
        with connect(f"ws{url.removeprefix('http')}api/v1/ws", subprotocols=protocols) as socket:
            expect(bool(socket.recv(PATIENCE)), "no WebSocket")


def expect(holds: bool, problem: str) -> None:
    """Raise Failed unless it holds."""
    if not holds:
        raise Failed(problem)


def find_pythons(names: Sequence[str] = PYTHONS) -> dict[str, str]:
    """Programs that are a Python, by their versions; a name without one behind it is left out."""
    pythons: dict[str, str] = {}
    for name in names:
        program = shutil.which(name)
        if program is None:
            continue
        answer = subprocess.run([program, "-V"], capture_output=True, text=True, check=False)
        if answer.returncode == 0:
            pythons[answer.stdout.split()[1]] = program
    return pythons


def requirements(wheel: Path) -> Iterator[Requirement]:
    """What the wheel says that it needs, its extras' too."""
    with zipfile.ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        head = HeaderParser().parsestr(archive.read(name).decode("utf-8"))
    yield from map(Requirement, head.get_all("Requires-Dist", []))


def lowest(wheel: Path) -> str:
    """Constraints that pin each requirement of the plain wheel and its gateway to its bound."""
    lines = []
    for requirement in requirements(wheel):
        if requirement.marker is None or requirement.marker.evaluate({"extra": "gateway"}):
            bound = next(
                specifier.version
                for specifier in requirement.specifier
                if specifier.operator == ">="
            )
            lines.append(f"{requirement.name}=={bound}\n")
    return "".join(sorted(lines))


def clean_environment(
    python: str, folder: Path, wheel: Path, *, constraints: str = ""
) -> InstalledEra:
    """The wheel and what it needs, nothing else; its commands run in an empty folder beside it."""
    subprocess.run([python, "-m", "venv", folder / "environment"], check=True)
    (folder / "empty").mkdir()
    (folder / "constraints.txt").write_text(constraints, encoding="utf-8")
    era = InstalledEra(folder / "environment" / "bin" / "python", folder / "empty")
    _install(era, str(wheel))
    return era


def _install(era: InstalledEra, requirement: str) -> None:
    constraints = str(era.folder.with_name("constraints.txt"))
    era.module(
        "pip", "--disable-pip-version-check", "install", "-qq", requirement, "-c", constraints
    )


def weigh(era: InstalledEra) -> Weight:
    """Its size without pip, which every environment has, and its times."""
    site = Path(era.script("import sysconfig; print(sysconfig.get_path('purelib'))"))
    has = [
        distribution.metadata["Name"]
        for distribution in importlib.metadata.distributions(path=[str(site)])
        if distribution.metadata["Name"] not in ("pip", "setuptools")
    ]
    sizes = {
        folder.name: _size(folder)
        for folder in site.iterdir()
        if not re.match(r"pip|setuptools|_distutils|distutils|pkg_resources", folder.name)
    }
    return Weight(
        total=sum(sizes.values()),
        ours=sum(sizes[name] for name in PACKAGES),
        distributions=len(has),
        help=_median(lambda: era("--help")),
        imported=_median(lambda: era.script(_USED)),
        bare=_median(lambda: era.script("")),
    )


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _median(run: Callable[[], object]) -> float:
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def try_out(python: str, wheel: Path, *, constraints: str) -> Weight:
    """Every step in a clean environment of this Python; raises Failed."""
    with tempfile.TemporaryDirectory(prefix="era-smoke-") as folder:
        era = clean_environment(python, Path(folder), wheel, constraints=constraints)
        for step in (try_first, try_files, try_wire, try_demo):
            step(era)
        weight = weigh(era)
        _install(era, f"{wheel}[gateway]")
        try_gateway(era)
    return weight


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--python", nargs="*", default=PYTHONS)
    parser.add_argument("--lowest", action="store_true")
    options = parser.parse_args()
    wheel = options.wheel.resolve()
    constraints = lowest(wheel) if options.lowest else ""
    pythons = find_pythons(options.python)
    failed = not pythons
    sys.stdout.write(f"{HEAD}\n")
    for version, program in pythons.items():
        try:
            weight = try_out(program, wheel, constraints=constraints)
        except Failed as error:
            sys.stderr.write(f"{version}: {error}\n")
            failed = True
        else:
            sys.stdout.write(f"{row(version, weight)}\n")
            sys.stdout.flush()
    untried = [name for name in options.python if shutil.which(name) not in pythons.values()]
    if untried:
        sys.stderr.write(f"not found, so not tried: {', '.join(untried)}\n")
    return int(failed)


def row(version: str, weight: Weight) -> str:
    """A line of the table under HEAD."""
    return (
        f"| {version} | {weight.distributions} | {weight.total / 1e6:.0f} "
        f"| {weight.ours / 1e6:.1f} | {weight.help:.2f} s "
        f"| {weight.imported:.2f} s, bare Python {weight.bare:.2f} s |"
    )


if __name__ == "__main__":
    sys.exit(main())
