"""The source has no path from the controller to the encoders that bypasses the guard."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import drivers

ROOT = Path(drivers.__file__).parents[1]
GUARD = ROOT / "drivers" / "guard" / "guard.py"
PACKAGES = ("drivers", "controller", "era_haptics", "model", "sim")
FILES = sorted(file for package in PACKAGES for file in (ROOT / package).rglob("*.py"))
ON_THE_WAY = [file for file in FILES if file.relative_to(ROOT).parts[0] in PACKAGES[:2]]
FORGING = {"_KEY", "__new__", "__class__", "__setattr__", "pickle", "copy"}

# Reads a configuration from a process of its own, and takes nothing else from it.
CONFIG_READER = ROOT / "controller" / "daemon" / "config_reader.py"

# Takes answers from a process of its own, and nothing of `drivers` (test_learning_messages.py).
MESSAGES = ROOT / "controller" / "learning" / "messages.py"

# Makes members of enumerations.
EXTENSIBLE_ENUM = ROOT / "drivers" / "protocol" / "extensible_enum.py"

# Makes requests of sets and envelopes, and of envelopes of voltage.
AMPLIFIER = ROOT / "drivers" / "amplifier.py"
CONVERSION = ROOT / "drivers" / "voltage" / "backend.py"

# Sends what the guard has made past the queue of an amplifier, and frames damaged on purpose.
CONFORMANCE = ROOT / "drivers" / "conformance"

# Sends sets of its own, and frames damaged on purpose, to amplifiers that it judges.
VERDICT = ROOT / "drivers" / "verdict"

# Ports of CAN adapters, which take and give packed frames.
WIRES = ROOT / "drivers" / "wires"

# The host of protocol 3: one class makes requests of sets, kinds of wire their bytes.
HOST = ROOT / "drivers" / "host"

# Messages that carry something an amplifier would play.
CARRIERS = {"Stage", "Apply", "LoadEnvelope"}


@cache
def text_of(file: Path) -> str:
    """The source text."""
    return file.read_text(encoding="utf-8")


@cache
def nodes(file: Path) -> list[ast.AST]:
    """All nodes of a file."""
    return list(ast.walk(ast.parse(text_of(file))))


def calls(file: Path, *parts: str) -> Iterator[tuple[str, ast.Call]]:
    """Calls in a file that has any of these parts of a name, with the last part of their name."""
    for node in nodes(file) if any(part in text_of(file) for part in parts) else ():
        if isinstance(node, ast.Call):
            called = node.func
            yield getattr(called, "attr", "") or getattr(called, "id", ""), node


def names(file: Path) -> Iterator[str]:
    """Every name, attribute and imported name in a file."""
    for node in nodes(file):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, ast.alias):
            yield node.name.rpartition(".")[2]


def test_only_the_guard_makes_safe_sets() -> None:
    """No other call of SafeCommandSet or SafeEnvelope; where sets pass, no forging of one."""
    made = {
        file: name
        for file in FILES
        for name, _ in calls(file, "SafeCommandSet", "SafeEnvelope")
        if name in ("SafeCommandSet", "SafeEnvelope")
    }
    assert set(made) == {GUARD}
    forging = {
        file: FORGING & set(names(file))
        for file in ON_THE_WAY
        if file not in (GUARD, CONFIG_READER, EXTENSIBLE_ENUM, MESSAGES)
        and any(name in text_of(file) for name in FORGING)
    }
    assert not any(forging.values()), forging


def test_only_the_amplifier_sends_sets() -> None:
    """Requests that carry a set or an envelope are made of checked ones, or by a decoder.

    In `Amplifier` they are made of what its own check let through, in the conversion to voltage of
    what the guard's package made; in the codecs only by what takes bytes apart. An encoder takes no
    other than these requests.
    """
    senders = set()
    for file in ON_THE_WAY:
        for name, call in calls(file, *CARRIERS):
            if name not in CARRIERS or CONFORMANCE in file.parents:
                continue
            senders.add(file.name)
            argument, *_ = [*call.args, *(keyword.value for keyword in call.keywords)]
            function = getattr(getattr(argument, "func", None), "id", "")
            if "codec" in file.parts:
                is_checked = "unpack" in function or "decode" in function
            else:
                is_checked = function == "_safe" or ast.unparse(argument) == "safe"
                is_checked = is_checked and file in (AMPLIFIER, CONVERSION)
            assert is_checked, f"{file}:{call.lineno} makes a {name}"
    assert "amplifier.py" in senders


def test_only_backends_use_encoders() -> None:
    """`encode_...` and `pack_...` are called by backends, codecs and raw lines, not from above."""
    users = {
        file
        for file in ON_THE_WAY
        for name, _ in calls(file, "encode_", "pack_")
        if name.startswith(("encode_", "pack_"))
    }
    assert users
    wires = {file for file in users if file.parent == HOST and file.name.endswith("_wire.py")}
    below = {"backends", "codec", "protocol"}
    above = [file for file in users - wires if not below & set(file.parts)]
    assert {file.parent for file in above} == {CONFORMANCE / "raw", VERDICT, WIRES, HOST}
    assert [file.name for file in above if file.parent == HOST] == ["amplifier.py"]


def test_only_what_a_ledger_admits_is_packed() -> None:
    """The host of protocol 3 makes the words of sets in one place, of what `admit` returned."""
    (packed,) = (
        ast.unparse(call.args[0])
        for file in ON_THE_WAY
        for name, call in calls(file, "pack_layers")
        if name == "pack_layers" and file.parent != VERDICT
    )
    admitted = [
        ast.unparse(node.targets[0])
        for node in nodes(HOST / "amplifier.py")
        if isinstance(node, ast.Assign) and ".ledger.admit(" in ast.unparse(node.value)
    ]
    assert admitted == [packed]


def test_only_the_conversion_changes_checked_sets() -> None:
    """The makers of sets and envelopes of voltage are called in one place: before the codec."""
    makers = ("safe_voltages", "safe_voltage_envelope")
    users = {file for file in FILES for name, _ in calls(file, *makers) if name in makers}
    assert users == {CONVERSION}
