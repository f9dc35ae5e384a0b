"""The source has no path from the controller to a wire that bypasses the ledger."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import drivers

ROOT = Path(drivers.__file__).parents[1]
ON_THE_WAY = sorted(
    file for package in ("drivers", "controller") for file in (ROOT / package).rglob("*.py")
)

# Sends sets of its own, and frames damaged on purpose, to amplifiers that it judges.
CONFORMANCE = ROOT / "drivers" / "judge" / "asking"

# Kinds of wire make the bytes of requests; ports of CAN adapters take and give packed frames.
WIRES = ROOT / "drivers" / "wires"

# One class makes requests of sets.
HOST = ROOT / "drivers" / "host"


@cache
def nodes(file: Path) -> list[ast.AST]:
    """All nodes of a file."""
    return list(ast.walk(ast.parse(file.read_text(encoding="utf-8"))))


def calls(file: Path, part: str) -> Iterator[tuple[str, ast.Call]]:
    """Calls in a file that has a part of a name, with the last part of their name."""
    for node in nodes(file) if part in file.read_text(encoding="utf-8") else ():
        if isinstance(node, ast.Call):
            called = node.func
            yield getattr(called, "attr", "") or getattr(called, "id", ""), node


def test_only_wires_use_encoders() -> None:
    """`encode_...` and `pack_...` are called by wires, codecs and the table, not from above."""
    users = {
        file
        for file in ON_THE_WAY
        for part in ("encode_", "pack_")
        for name, _ in calls(file, part)
        if name.startswith(part)
    }
    wires = {file for file in users if WIRES in file.parents}
    assert {file.parent.name for file in wires if file.name == "host.py"} == {
        "can_bus",
        "serial_line",
    }
    above = [file for file in users - wires if "protocol" not in file.parts]
    assert {file.parent for file in above} == {CONFORMANCE, HOST}
    assert [file.name for file in above if file.parent == HOST] == ["dialogue.py"]


def test_only_what_a_ledger_admits_is_packed() -> None:
    """The host makes the words of sets in one place, of what `admit` returned."""
    (packed,) = (
        ast.unparse(call.args[0])
        for file in ON_THE_WAY
        for name, call in calls(file, "pack_layers")
        if name == "pack_layers" and file.parent != CONFORMANCE
    )
    admitted = [
        ast.unparse(node.targets[0])
        for node in nodes(HOST / "dialogue.py")
        if isinstance(node, ast.Assign) and ".ledger.admit(" in ast.unparse(node.value)
    ]
    assert admitted == [packed]
