"""The C sources: structs by the names of their fields, and no circle of files."""

import re
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from typed_page import installed_program

ROOT = Path(__file__).parents[2]
PAIR = "struct pair { int a, b; };\nstruct pair "


def problems(root: Path) -> list[str]:
    """What the check of sources finds in a checkout."""
    installed_program("gcc", package="gcc")
    command = [sys.executable, ROOT / "firmware" / "test" / "sources.py", root]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == bool(done.stdout.strip()), done.stderr
    return done.stdout.splitlines()


def test_sources_pass() -> None:
    """Those of firmware, example and kernels."""
    assert problems(ROOT) == []


def test_ranges_of_the_header_are_used() -> None:
    """A quantity that only a board or a host needs has none."""
    paths = [each for each in (ROOT / "firmware").rglob("*.[ch]") if each.name != "protocol.h"]
    used = "".join(each.read_text("utf-8") for each in paths)
    header = (ROOT / "firmware" / "core" / "protocol.h").read_text("utf-8")
    ranges = re.findall(r"\b(?:WIRE_\w+|\w+_PER_UNIT)\b", header)
    assert len(ranges) > 10
    assert [each for each in ranges if not re.search(rf"\b{each}\b", used)] == []


@pytest.mark.parametrize(
    ("sources", "place"),
    [
        ({"a.c": f"{PAIR}one = {{1, 2}};"}, "firmware/core/a.c:2:"),
        ({"a.c": f"{PAIR}all[] = {{{{.a = 1}}, {{3}}}};"}, "firmware/core/a.c:2:"),
        ({"a.h": '#include "b.h"', "b.h": "int b;", "b.c": '#include "a.h"'}, "a < b < a"),
        ({"a.c": "int b(void); int a(void) { return b(); }"}, "a < b < a"),
        ({"../a.c": ""}, "firmware/a.c: its folder"),
    ],
    ids=["by position", "within", "circle of headers", "circle of uses", "elsewhere"],
)
def test_what_is_wrong_is_found(sources: Mapping[str, str], place: str, tmp_path: Path) -> None:
    """An initialiser by position, and a circle of what files include or use of each other."""
    folder = tmp_path / "firmware" / "core"
    folder.mkdir(parents=True)
    (folder / "b.c").write_text("int a(void); int b(void) { return a(); }")
    for name, text in sources.items():
        (folder / name).write_text(text)
    assert place in problems(tmp_path)[0]
