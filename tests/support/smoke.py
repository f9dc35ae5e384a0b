"""The wheel alone, in clean environments: does it work, and what does it weigh?

    python tests/support/smoke.py WHEEL [--python PYTHON ...] [--lowest]

Each Python that is found gets an environment with nothing but the wheel and what it needs, then its
extra `gateway`; what a user types first must work in an empty folder. Prints a row for each Python;
exit status 1 where something failed or none was found. --lowest: with the lowest version that each
bound in the wheel allows.
"""

import argparse
import importlib.metadata
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from email.parser import HeaderParser
from pathlib import Path

from packaging.requirements import Requirement

from packages import PACKAGES
from processes.typed_page import (
    Failed,
    InstalledEra,
    try_demo,
    try_files,
    try_first,
    try_gateway,
    try_wire,
)

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


def find_pythons(names: Sequence[str] = PYTHONS) -> dict[str, str]:
    """Programs that are a Python, by their versions; a name without one behind it is left out."""
    found: dict[str, str] = {}
    for name in names:
        program = shutil.which(name)
        if program is None:
            continue
        said = subprocess.run([program, "-V"], capture_output=True, text=True, check=False)
        if said.returncode == 0:
            found[said.stdout.split()[1]] = program
    return found


def requirements(wheel: Path) -> Iterator[Requirement]:
    """What the wheel says that it needs, its extras' too."""
    with zipfile.ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        head = HeaderParser().parsestr(archive.read(name).decode("utf-8"))
    yield from map(Requirement, head.get_all("Requires-Dist", []))


def lowest(wheel: Path) -> str:
    """Constraints that pin each requirement of the plain wheel and its gateway to its bound."""
    lines = []
    for one in requirements(wheel):
        if one.marker is None or one.marker.evaluate({"extra": "gateway"}):
            bound = next(each.version for each in one.specifier if each.operator == ">=")
            lines.append(f"{one.name}=={bound}\n")
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


def _install(era: InstalledEra, what: str) -> None:
    constraints = str(era.folder.with_name("constraints.txt"))
    era.module("pip", "--disable-pip-version-check", "install", "-qq", what, "-c", constraints)


def weigh(era: InstalledEra) -> Weight:
    """Its size without pip, which every environment has, and its times."""
    site = Path(era.script("import sysconfig; print(sysconfig.get_path('purelib'))"))
    has = [
        one.metadata["Name"]
        for one in importlib.metadata.distributions(path=[str(site)])
        if one.metadata["Name"] not in ("pip", "setuptools")
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
    with tempfile.TemporaryDirectory(prefix="era-smoke-") as made:
        era = clean_environment(python, Path(made), wheel, constraints=constraints)
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
    given = parser.parse_args()
    wheel = given.wheel.resolve()
    constraints = lowest(wheel) if given.lowest else ""
    pythons = find_pythons(given.python)
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
    untried = [name for name in given.python if shutil.which(name) not in pythons.values()]
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
