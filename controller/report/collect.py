"""What a bug report should hold: versions, configuration, the daemon, its last messages."""

import json
import platform
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution, entry_points, requires, version
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from controller.api.client import Client
from controller.api.jsonrpc import RpcError
from controller.daemon.config import is_daemon_document
from controller.daemon.fault_dumps import DUMP_PATTERN
from controller.report.redaction import redacted
from drivers.errors import LinkError
from model.config.document import read_document
from model.errors import InputError

LARGEST_FILE = 1 << 20  # bytes of one file that is put in
MAX_DUMPS = 5
_GROUPS = "era_haptics."  # what the groups of our entry points begin with
_NAMED = ("rig", "layout")  # files that a daemon's file names; a table is large and can be built


@dataclass(frozen=True)
class Report:
    """Files of a report by name, and what could not be gathered, in words."""

    files: Mapping[str, str]
    missing: tuple[str, ...]


def collect(configs: Iterable[Path], *, socket: Path | None, home: Path) -> Report:
    """Gather everything; never fails for what is not there.

    configs: rigs, layouts and daemons' files; what a daemon's file names is put in with it. socket:
    the daemon's, its usual place if None. home: the folder that is shown as ~.
    """
    files: dict[str, str] = {}
    missing: list[str] = []
    for path in configs:
        for named in _with_named(path, missing):
            _take(named, files, missing)
    files["versions.json"] = json.dumps(versions(), indent=2)
    try:
        with Client.connect(socket, name="era report") as daemon:
            files["status.json"] = daemon.status().model_dump_json(indent=2)
    except (LinkError, RpcError) as error:
        missing.append(f"status of a daemon: {error}")
    return Report(
        {name: redacted(text, home=home) for name, text in files.items()},
        tuple(redacted(text, home=home) for text in missing),
    )


def versions() -> dict[str, Any]:
    """Versions of Python, the system, era-haptics, what it needs, and all plug-ins."""
    needed = {}
    for line in requires("era-haptics") or ():
        name = Requirement(line).name
        try:
            needed[name] = version(name)
        except PackageNotFoundError:
            needed[name] = "not installed"
    plug_ins = {
        group.removeprefix(_GROUPS): _claimed(group)
        for group in sorted(entry_points().groups)
        if group.startswith(_GROUPS)
    }
    return {
        "era-haptics": version("era-haptics"),
        "installed": distribution("era-haptics").read_text("direct_url.json") or "from an index",
        "python": sys.version,
        "system": platform.platform(),
        "machine": platform.machine(),
        "packages": dict(sorted(needed.items())),
        "plug-ins": plug_ins,
    }


def _claimed(group: str) -> dict[str, str]:
    """Every name of a group, with all that claim it."""
    claims: dict[str, list[str]] = {}
    for point in sorted(entry_points(group=group)):
        claims.setdefault(point.name, []).append(f"{point.value} ({_package(point.dist)})")
    return {name: ", ".join(claimants) for name, claimants in claims.items()}


def _package(dist: Any) -> str:
    return f"{dist.name} {dist.version}" if dist is not None else "unknown"


def _with_named(path: Path, missing: list[str]) -> Iterable[Path]:
    """A configuration file, the files that it names, and the last dumps of a daemon's."""
    yield path
    try:
        document = read_document(path)
    except InputError as error:
        if path.is_file():  # else what is left out says it
            missing.append(f"what this file names: {error}")
        return
    if not is_daemon_document(document):
        return
    for key in _NAMED:
        value = document.data.get(key)
        if isinstance(value, str):
            yield path.parent / Path(value).expanduser()
    dumps = document.data.get("dumps")
    folder = dumps.get("folder") if isinstance(dumps, dict) else None
    if isinstance(folder, str):
        found = (path.parent / Path(folder).expanduser()).glob(DUMP_PATTERN)
        yield from sorted(found, key=lambda file: file.name)[-MAX_DUMPS:]


def _take(path: Path, files: dict[str, str], missing: list[str]) -> None:
    """Put a text file in under its name; one that is too large with its end only."""
    try:
        with path.open("rb") as stream:
            stream.seek(max(0, path.stat().st_size - LARGEST_FILE))
            text = stream.read(LARGEST_FILE).decode("utf-8", errors="replace")
    except OSError as error:
        missing.append(f"{path}: {error.strerror}")
        return
    name = path.name
    while name in files:
        name = f"another-{name}"
    files[name] = text
