"""Retired words in identifiers, and names that mislead: `make lint` lists them and fails.

docs/reference/glossary.md defines the words that are used in place of retired ones. A module has a
name of its own, but for those that a package may have by custom. A class is a noun of the field, no
bare participle; only an error may be named by what happened.
"""

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[3]
PACKAGES = ("controller", "drivers", "era_haptics", "examples", "model", "registry", "sim")
PAGES = ("README.md", "docs/how-to/*.md", "docs/reference/*.md", "docs/tutorials/*.md")
"""Whose programs users copy, as they copy the examples."""

RETIRED = {
    "squared": "eigenvalues",
    "hold": "dynamic_stiffness",
    "answers": "modal_receptance",
    "turn": "phase_factor",
    "zeta": "shifted_eigenvalue, or damping_ratio",
    "CLOSE": "PRUNE_MARGIN",
    "MOVES": "LAWSON_STEPS",
    "Order|OrderMaker": "CommandSet and its envelopes",
    "Means": "PlaybackCapabilities",
    "Station|Site": "AmplifierDevice, SimulationContext",
    "Phase": "GroupState",
    "bad|foreign": "invalid_frames, unexpected_frames",
    "misses|proves": "failed_count, requirement",
}
"""Whole identifiers."""

RETIRED_WORDS = {
    "momenta": "mass_weighted_modes",
    "likeness": "MAC, the modal assurance criterion",
    "drive_vector": "Weights",
    "brakes?": "ending",
    "spread": "std, bandwidth or radius",
    "promising": "MAX_CANDIDATES",
    "move_shares": "lawson_iterations",
    "likely": "expected",
    "gave_way|gives?_way|given_way": "Preempted, preempt",
    "hurry|hurried": "abort_unsent",
    "beaten|borne": "a word for the event, MIN_HEARTBEATS_PER_WATCHDOG",
    "keep_free": "reserve",
    "told|told_after": "reported, notified, loss_detection_time",
    "left_out": "skipped",
    "torn": "incomplete",
    "is_contradicted": "duplicate_responder",
    "stand_in": "PORT_OPENER",
    "befalls?|episodes?": "inject_fault, FaultWindow",
    "stations?": "AmplifierDevice",
    "sites?": "SimulationContext",
    "moot": "superseded",
    "wish|wishes|wished": "intent",
    "telegrams?": "ADU",
    "dearest|dear": "SLOWEST",
    "nearness": "suggestions",
    "unaware": "imperceptible",
    "because": "reason",
    "trouble": "errors",
    "nobody|somebody|anybody|everybody|whoever": "the component's name",
    "patience": "_TIMEOUT",
    "(?<!at_)most|longest|usual": "MAX_, DEFAULT_",
    "persistently": "retry_while_degraded",
    "or_less": "is_limit",
    "sole": "HostLock",
    "sounding": "frequencies_at",
    "at_one_moment": "simultaneous",
}
"""Words within identifiers; they are split at underscores and capitals."""

RETIRED_IN_DRIVERS = {
    "asks?|asked|asking": "request, requested",
    "wanted": "requested, expected",
    "begin|begun": "start, started_at",
    "places": "positions",
}
"""Words within identifiers of the packages that follow a touch to the wire."""

DRIVER_PACKAGES = (
    "controller/",
    "drivers/",
    "era_haptics/",
    "registry/",
    "examples/",
    "README.md",
    "docs/",
)

CONTACT_PACKAGES = ("controller/sources/", "controller/play/", "sim/")
"""Where `lease`, the word of arming, would mean the timeout of a contact."""

ALLOWED = {
    "answers": "JSON of `era table verify` and `era amp discover`: not modal ones",
    "hold": "a parameter of the effect `ramp`: the last level is held",
    "places": "JSON of `era amp discover`",
    "CLOSE": "an event and an action of the daemon: it closes its amplifiers",
}
"""Identifiers in which the word has its ordinary meaning, and which."""

_IDENTIFIER = re.compile(r"[^\W\d]\w*")  # also in comments: for which files need be parsed
_PROGRAM = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def retired_identifiers() -> Iterator[str]:
    """Yield `path:line: identifier, use ...` for each definition that has a retired word."""
    for file, text in _programs():
        names = {(Path(file).stem, 1)}
        if any(_replacement(name, file) for name in {*_IDENTIFIER.findall(text)}):
            names |= {*_definitions(ast.parse(text))}
        for name, line in sorted(names, key=lambda entry: entry[1]):
            instead = _replacement(name, file)
            if instead is not None:
                yield f"{file}:{line}: {name}, use {instead}"


def _programs() -> Iterator[tuple[str, str]]:
    """Path and text of each module, and of each program on a page, at the lines of the page."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), path.read_text("utf-8")
    for pattern in PAGES:
        for path in sorted(ROOT.glob(pattern)):
            page = path.read_text("utf-8")
            for fence in _PROGRAM.finditer(page):
                above = page[: fence.start(1)].count("\n")
                yield path.relative_to(ROOT).as_posix(), "\n" * above + fence[1]


def _definitions(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Names of functions, classes, arguments, assigned variables and attributes, and JSON keys."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                yield name, node.lineno
            case ast.ClassDef(name=name) | ast.arg(arg=name):
                yield name, node.lineno
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name, node.lineno
            case ast.Dict(keys=keys):  # of JSON
                yield from (
                    (key.value, key.lineno)
                    for key in keys
                    if isinstance(key, ast.Constant) and isinstance(key.value, str)
                )


def _replacement(name: str, file: str) -> str | None:
    return _replacement_in(
        name.strip("_"), file.startswith(DRIVER_PACKAGES), file.startswith(CONTACT_PACKAGES)
    )


@cache
def _replacement_in(plain: str, is_in_drivers: bool, is_near_contacts: bool) -> str | None:
    if plain in ALLOWED:
        return None
    for pattern, instead in RETIRED.items():
        if re.fullmatch(pattern, plain):
            return instead
    retired = [*RETIRED_WORDS.items(), *(RETIRED_IN_DRIVERS.items() if is_in_drivers else ())]
    if is_near_contacts:
        retired.append(("leases?", "contact_timeout"))
    words = _words(plain)
    for pattern, instead in retired:
        if re.search(rf"(?:^|_)(?:{pattern})(?:_|$)", words):
            return instead
    return None


def _words(plain: str) -> str:
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", plain).lower()


SHARED_MODULES = ("__init__", "__main__", "cli", "errors")

_REGULAR = re.compile(r"[A-Z][a-z]+ed")
_IRREGULAR = re.compile(
    "Built|Chosen|Drawn|Felt|Found|Given|Heard|Held|Kept|Known|Left|Made|Meant|Met|Playing|Sent"
    "|Shown|Sought|Taken|Told|Unknown|Unsent"
)


def misleading_names(root: Path) -> Iterator[str]:
    """Yield one line for each name in the packages of a checkout that breaks a rule."""
    modules: dict[str, list[str]] = defaultdict(list)
    classes: dict[str, list[str]] = defaultdict(list)
    bases: dict[str, list[str]] = defaultdict(list)
    for package in sorted({*PACKAGES} - {"examples"}):
        for path in sorted((root / package).rglob("*.py")):
            file = path.relative_to(root).as_posix()
            modules[path.stem].append(file)
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    classes[node.name].append(f"{file}:{node.lineno}")
                    bases[node.name] += map(ast.unparse, node.bases)
    for name, files in modules.items():
        if len(files) > 1 and name not in SHARED_MODULES:
            yield f"module {name} must have a name of its own, got {', '.join(files)}"
    for name, places in classes.items():
        if is_participle(name) and not _is_error(name, bases):
            yield f"class {name} must be a noun, got a bare participle in {places[0]}"


def is_participle(name: str) -> bool:
    """Return whether a class is named by a participle alone, such as `Chosen` or `_Joined`."""
    plain = name.strip("_")
    return bool(_REGULAR.fullmatch(plain) or _IRREGULAR.fullmatch(plain))


def _is_error(name: str, bases: Mapping[str, Sequence[str]]) -> bool:
    """Return whether a class derives from an error, over classes of the product."""
    return name.endswith("Error") or any(_is_error(base, bases) for base in bases.get(name, ()))


_REMEDY = """\
Rename these. A retired word had several meanings here; docs/reference/glossary.md has the words in
use. If an identifier needs the word in its ordinary meaning, add it to ALLOWED in
tests/support/checks/vocabulary.py with the reason.
"""


def main() -> int:
    """Print each identifier with a retired word and each misleading name; return 1 for any."""
    retired = list(retired_identifiers())
    misleading = list(misleading_names(ROOT))
    problems = [*retired, *misleading]
    sys.stderr.writelines(f"{problem}\n" for problem in problems)
    if retired:
        sys.stderr.write(_REMEDY)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
