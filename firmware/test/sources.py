"""Check the C sources of a checkout: `python firmware/test/sources.py [ROOT]`; exit 1 if any fails.

- Every struct is initialised by the names of its fields, since positions shift without a word when
  a field is added: gcc refuses others where each struct has the attribute `designated_init`.
- No circle of files: the header and the source of a name are one file, which needs what it includes
  and, as its object says, the files of the functions and objects that it uses.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

_CORE = ("firmware/core", "firmware/wire")
_ARM = "-mcpu=cortex-m3"
PROGRAMS: Mapping[tuple[str, ...], Sequence[str]] = {
    (*_CORE, "firmware/ports/posix", "firmware/test"): ["-std=c99"],
    (*_CORE, "firmware/ports/sound"): ["-std=c99", '-DCONFIG_FILE="sound_config.h"'],
    (*_CORE, "firmware/ports/cortex-m"): ["-std=c99", _ARM],
    (*_CORE, "firmware/ports/cortex-m", "firmware/test/cost"): ["-std=c99", _ARM],
    ("examples/smallest_amplifier", "tests/programs"): ["-std=c11", "-D_GNU_SOURCE"],
    ("model/compiled", "tests/model"): ["-std=gnu11", "-DLANES=4"],
}
"""Folders whose files are compiled together, with the options of the compiler."""
BY_NAME = (
    *("-Dstruct=struct __attribute__((designated_init))", "-Wno-attributes"),
    *("-Werror=designated-init", "-Werror=missing-braces"),  # the first field without its braces
)

Needs = dict[str, set[str]]


def problems(root: Path) -> Iterator[str]:
    """Yield what is wrong with the sources of a checkout, with its place."""
    checked = {root / folder for folders in PROGRAMS for folder in folders}
    written = root / "out", root / "docs" / "_build"
    for path in sorted(root.glob("[a-z]*/**/*.[ch]")):
        if path.parent not in checked and not any(map(path.is_relative_to, written)):
            yield f"{path.relative_to(root)}: its folder must be one of PROGRAMS"
    for folders, options in PROGRAMS.items():
        paths = [path for each in folders for path in sorted((root / each).glob("*.[ch]"))]
        prefix = "arm-none-eabi-" if _ARM in options else ""
        if not shutil.which(f"{prefix}gcc"):
            continue  # `make firmware-test` fails without it in CI
        includes = [f"-I{root / each}" for each in folders]
        command = [f"{prefix}gcc", "-O0", *options, *BY_NAME, *includes]
        with tempfile.TemporaryDirectory() as made:
            objects = {path: Path(made) / f"{path.stem}.o" for path in paths if path.suffix == ".c"}
            positional = [
                error
                for path, compiled in objects.items()
                for error in _errors([*command, "-c", "-o", compiled, path], root)
            ]
            nm = f"{prefix}nm"
            yield from positional or _circle(_needs(paths, objects, nm))  # of whole objects


def _errors(command: Sequence[str | Path], root: Path) -> Iterator[str]:
    text = subprocess.run(command, capture_output=True, text=True, check=False).stderr
    yield from (line.removeprefix(f"{root}/") for line in text.splitlines() if "error:" in line)


def _needs(paths: Sequence[Path], objects: Mapping[Path, Path], nm: str) -> Needs:
    """Return the names that each name of a file needs; nm: the program that lists symbols."""
    needs: Needs = {path.stem: set() for path in paths}
    for path in paths:
        needs[path.stem] |= set(re.findall(r'#include "(\w+)\.[ch]"', path.read_text("utf-8")))
    makers, users = defaultdict[str, set[str]](set), defaultdict[str, set[str]](set)
    for path, compiled in objects.items():
        listed = subprocess.check_output([nm, "--extern-only", "-P", compiled], text=True)
        for name, kind, *_ in map(str.split, listed.splitlines()):
            (users if kind == "U" else makers)[name].add(path.stem)
    for name, stems in users.items():
        for stem in stems:
            needs[stem] |= makers[name]
    return {stem: others & needs.keys() - {stem} for stem, others in needs.items()}


def _circle(needs: Needs) -> Iterator[str]:
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as found:
        yield f"files must not need each other in a circle, got {' < '.join(found.args[1])}"


if __name__ == "__main__":
    wrong = [*problems(Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[2]))]
    sys.stdout.writelines(f"{each}\n" for each in wrong)
    sys.exit(bool(wrong))
