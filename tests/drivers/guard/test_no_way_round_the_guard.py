"""The source has no path from the controller to the encoders that bypasses the guard."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

import controller
import drivers
import era_haptics
import model
import sim


def files(*packages: ModuleType) -> list[Path]:
    """All source files of packages."""
    roots = [Path(package.__file__).parent for package in packages if package.__file__]
    return sorted(file for root in roots for file in root.rglob("*.py"))


FILES = files(drivers, controller)
ASIDE = files(era_haptics, model, sim)  # not between controller and wire
GUARD = Path(drivers.__file__).parent / "guard" / "guard.py"
ENCODERS = {"backends", "codec"}

# Messages that carry something an amplifier would play.
CARRIERS = {"Stage", "Apply", "LoadEnvelope"}


@cache
def tree(file: Path) -> ast.Module:
    """Parse a file."""
    return ast.parse(file.read_text(encoding="utf-8"))


def calls(file: Path) -> Iterator[tuple[str, ast.Call]]:
    """Every call in a file, with the last part of the name of what is called."""
    for node in ast.walk(tree(file)):
        if isinstance(node, ast.Call):
            called = node.func
            yield (
                called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", ""),
                node,
            )


def names(file: Path) -> set[str]:
    """Every name, attribute and imported name in a file."""
    found = set()
    for node in ast.walk(tree(file)):
        if isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.alias):
            found.add(node.name.rpartition(".")[2])
    return found


def test_source_scan_finds_the_guard() -> None:
    """The walk sees the guard, the amplifier and the control loop."""
    seen = {file.name for file in FILES}
    assert {"guard.py", "amplifier.py", "exchanges.py", "loop.py"} <= seen
    assert any(name == "SafeCommandSet" for name, _ in calls(GUARD))


@pytest.mark.parametrize("file", [file for file in FILES if file != GUARD], ids=str)
def test_only_the_guard_makes_safe_sets(file: Path) -> None:
    """No call of SafeCommandSet or SafeEnvelope, no key, no forging around a constructor."""
    made = [name for name, _ in calls(file) if name in ("SafeCommandSet", "SafeEnvelope")]
    assert made == []
    assert names(file).isdisjoint({"_KEY", "__new__", "__class__", "__setattr__", "pickle", "copy"})


def test_other_packages_make_no_safe_sets() -> None:
    """Simulation, model and notebook API."""
    made = [file for file in ASIDE for name, _ in calls(file) if name.startswith("Safe")]
    assert ASIDE
    assert made == []


@pytest.mark.parametrize("file", FILES, ids=str)
def test_only_the_amplifier_sends_sets(file: Path) -> None:
    """Requests that carry a set or an envelope are made of checked ones, or by a decoder.

    In `Amplifier` they are made of what its own check let through; in the codecs only by what
    takes bytes apart. An encoder takes no other than these requests.
    """
    for name, call in calls(file):
        if name not in CARRIERS:
            continue
        (argument,) = [*call.args, *(keyword.value for keyword in call.keywords)]
        if "codec" in file.parts:
            decoder = argument.func if isinstance(argument, ast.Call) else None
            assert "unpack" in getattr(decoder, "id", "") or "decode" in getattr(decoder, "id", "")
        elif file.name == "amplifier.py":
            checked = isinstance(argument, ast.Call) and argument.func.id == "_safe"
            assert checked or ast.unparse(argument) == "safe"
        else:
            raise AssertionError(f"{file}:{call.lineno} makes a {name}")


@pytest.mark.parametrize("file", FILES, ids=str)
def test_only_backends_use_encoders(file: Path) -> None:
    """`encode_...` and `pack_...` are called by backends and codecs, not from above."""
    if ENCODERS & set(file.parts):
        return
    assert [name for name, _ in calls(file) if name.startswith(("encode_", "pack_"))] == []
