"""`era report`: collect the files for a bug report in one folder.

The folder contains versions, configuration, the daemon's status and the end of its log, reduced by
`era_haptics.lab.harmless` to harmless values of known keys.
"""

import json
import os
import platform
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import distributions, entry_points, version
from pathlib import Path
from typing import Any

from controller.api.client import Client
from controller.api.jsonrpc import RpcError
from controller.daemon.config import file_of, is_daemon_document
from controller.effects.layout import is_layout_document
from drivers.errors import LinkError
from era_haptics.lab.harmless import (
    Names,
    harmless_configuration,
    harmless_json,
    harmless_records,
)
from model.config.document import ConfigError, Document, is_file_name, read_document
from model.errors import InputError
from registry.files import regular_file
from registry.plugins import plugins_of

MAX_FILE_SIZE = 1 << 20  # bytes; only the end of a larger file is included
_GROUPS = "era_haptics."  # prefix of our entry point groups


@dataclass(frozen=True)
class CollectedFile:
    """One file of a report."""

    text: str
    source: Path | None = None
    """Path of the original, shown only to the user; None for data collected by the report."""


@dataclass(frozen=True)
class ReportContents:
    """Contents of a report: files by name, and missing files, described without user data."""

    files: Mapping[str, CollectedFile]
    missing: list[str]


class _Report:
    """Files named after their kinds, so that no user-defined name is in the report."""

    def __init__(self) -> None:
        self.files: dict[str, CollectedFile] = {}
        self.missing: list[str] = []
        self.names = Names()
        self._seen: set[str] = set()
        self._documents: list[tuple[str, Path, Document]] = []

    def add_configuration(self, path: Path) -> None:
        """Read a configuration file and the files it refers to; `collected` reduces them."""
        if not self._is_new(path):
            return
        try:
            document = read_document(path)
        except ConfigError as error:
            self._add_unreadable(path, [problem.line for problem in error.problems])
            return
        harmless_configuration(document, self.names)  # declares its names
        name = self._new_name(_kind_of(document), ".yaml")
        self._documents.append((name, path, document))
        self._add(name, "", path)
        for named in _named_by(document):
            self.add_configuration(named)
        if is_daemon_document(document):
            self._add_log(document)

    def _add_unreadable(self, path: Path, lines: Sequence[int | None]) -> None:
        """Add a file that cannot be parsed; only the position of the error is shown."""
        name = self._new_name("unreadable", ".yaml")
        if not path.exists():
            self.missing.append(f"{name}: no such file")
            return
        numbers = ", ".join(str(line) for line in lines if line is not None)
        place = f" at line {numbers}" if numbers else ""
        self._add(name, f"# not valid YAML{place}; hidden\n", path)
        self.missing.append(f"{name}: not valid YAML{place}; files that it refers to are left out")

    def _add_log(self, daemon: Document) -> None:
        """Add the log of a daemon."""
        path = file_of(daemon, "log", "file")
        if path is None or not self._is_new(path):
            return
        name = self._new_name("log", ".jsonl")
        try:
            self._add(name, _end_of(path), path)
        except OSError as error:
            self.missing.append(f"{name}: {error.strerror}")

    def add_status(self, socket: Path | None) -> None:
        """Add the status of the running daemon."""
        try:
            with Client.connect(socket, name="era report") as daemon:
                status = daemon.status().model_dump_json()
        except (LinkError, RpcError) as error:
            self.missing.append(f"status of a daemon ({type(error).__name__})")
            return
        self._add("status.json", harmless_json(status, self.names))

    def collected(self) -> ReportContents:
        """Return all files, reduced once all their names are known."""
        shown = dict(self.files)
        for name, path, document in self._documents:
            text = harmless_configuration(document, self.names)
            shown[name] = CollectedFile(text, path)
        for name, file in self.files.items():
            if name.endswith(".jsonl"):
                text = harmless_records(file.text, self.names)
                shown[name] = CollectedFile(text, file.source)
        shown["versions.json"] = CollectedFile(json.dumps(installed_versions(), indent=2))
        return ReportContents(shown, self.missing)

    def _is_new(self, path: Path) -> bool:
        """Return whether a file is new, under this path or another."""
        place = os.path.realpath(path)
        is_new = place not in self._seen
        self._seen.add(place)
        return is_new

    def _add(self, name: str, text: str, source: Path | None = None) -> None:
        self.files[name] = CollectedFile(text, source)
        if source is not None:
            self.names.files[os.path.realpath(source)] = name

    def _new_name(self, kind: str, ending: str) -> str:
        name, number = f"{kind}{ending}", 1
        taken = {*self.files, *(line.partition(":")[0] for line in self.missing)}
        while name in taken:
            number += 1
            name = f"{kind}-{number}{ending}"
        return name


def collect(configs: Iterable[Path], *, socket: Path | None) -> ReportContents:
    """Collect the files of a report.

    configs: rig, layout and daemon files; for a daemon file, also the files and the log that it
    refers to; socket: the daemon's socket, the default socket if None.
    """
    report = _Report()
    for path in configs:
        report.add_configuration(path)
    report.add_status(socket)
    return report.collected()


def write_report(folder: Path, report: ReportContents) -> None:
    """Write a new folder with mode 0700, completely or not at all.

    Raises InputError if it already exists or cannot be created, OSError if writing fails.
    """
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError as error:
        raise InputError(f"{folder}: already exists; choose another folder with -o") from error
    except OSError as error:
        raise InputError(f"{folder}: cannot write: {error.strerror}") from error
    missing = CollectedFile("".join(f"{line}\n" for line in report.missing))
    try:
        for name, file in {**report.files, "missing.txt": missing}.items():
            (folder / name).write_text(file.text, "utf-8")
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def installed_versions() -> dict[str, Any]:
    """Return versions of Python, the system, era-haptics, installed packages and plug-ins."""
    plug_ins = {
        group.removeprefix(_GROUPS): {
            name: ", ".join(sorted(f"{point.value} ({_package(point.dist)})" for point in points))
            for name, points in sorted(plugins_of(group).items())
        }
        for group in sorted(entry_points().groups)
        if group.startswith(_GROUPS)
    }
    return {
        "era-haptics": version("era-haptics"),
        "python": sys.version,
        "system": platform.platform(),
        "machine": platform.machine(),
        "packages": dict(_packages(tuple(sys.path))),
        "plug-ins": plug_ins,
    }


@cache
def _packages(path: tuple[str, ...]) -> Sequence[tuple[str, str]]:
    """Return name and version of each installed package, sorted; path: module search path."""
    return sorted((each.name, each.version) for each in distributions(path=[*path]))


def _package(dist: Any) -> str:
    return f"{dist.name} {dist.version}" if dist is not None else "unknown"


def _kind_of(document: Document) -> str:
    if is_daemon_document(document):
        return "daemon"
    return "layout" if is_layout_document(document) else "rig"


def _named_by(document: Document) -> Iterator[Path]:
    """Yield the configuration files that a file refers to: its base, a daemon's rig and layouts.

    Tables are left out: they are large and can be built again.
    """
    base = document.data.get("base")
    if is_file_name(base):
        yield document.beside(base)
    if not is_daemon_document(document):
        return
    rig = file_of(document, "rig")
    if rig is not None:
        yield rig
    layouts = document.data.get("layouts")
    for name in layouts if isinstance(layouts, dict) else ():
        layout = file_of(document, "layouts", name)
        if layout is not None:
            yield layout


def _end_of(path: Path) -> str:
    """Return a text file, or the end of a large one. Raises OSError."""
    with open(path, "rb", opener=regular_file) as stream:
        stream.seek(max(0, path.stat().st_size - MAX_FILE_SIZE))
        return stream.read(MAX_FILE_SIZE).decode("utf-8", errors="replace")
