"""`era report`: collect what a bug report needs in one file.

The file has versions, configuration, the daemon's status and its fault dumps. Values of keys that
this program does not know are hidden. Free text, as in causes and names, is not searched: look at
the file before you send it.
"""

import json
import os
import platform
import re
import sys
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, entry_points, requires, version
from pathlib import Path
from typing import Any

from pydantic.json_schema import models_json_schema

from controller.api.client import Client
from controller.api.jsonrpc import RpcError
from controller.api.methods import StatusResult
from controller.daemon.config import DaemonSection, file_of, is_daemon_document
from controller.effects.layout import LayoutSection
from controller.operation.fault_dumps import DUMP_PATTERN
from drivers.errors import LinkError
from drivers.protocol.definition import EVENT_RECORD, IDENTITY, MESSAGES, NAK_RECORD
from drivers.protocol.records import Record, Rows
from model.config.document import read_document
from model.errors import InputError
from model.rig.sections import RigSection
from registry.files import regular_file
from registry.plugins import plugins_of

MAX_FILE_SIZE = 1 << 20  # bytes; of a larger file only the end is included
MAX_DUMPS = 5
_GROUPS = "era_haptics."  # prefix of our entry point groups
_REQUIREMENT = re.compile(r"(?im)^[ \t]*([A-Z0-9](?:[A-Z0-9._-]*[A-Z0-9])?)")
"""The name of the distribution at the start of each line, a requirement of PEP 508."""

_COMMENT = re.compile(r"(?m)(?:^|(?<=\s))#.*$")
_HOST = re.compile(r"(?<=://)[^/?#\s\"']+")
_PARAMETER = re.compile(r"""([\w-]+)(=)([^\s,&#}"']+)""")  # of a URL
_ENTRY = re.compile(
    r"""([\w-]+)(["']?[ \t]*:[ \t]*)(?!//)("[^"\n]*"|'[^'\n]*'|[^\s,{}\[\]"'][^\n,{}\[\]"']*)"""
)  # of YAML or JSON

_HIDDEN = "hidden"

_OF_FILES = (RigSection, DaemonSection, LayoutSection, StatusResult)
_PRIVATE = frozenset({"serial_number"})
_OTHERS = ("baud", "bitrate", "timeout", "cause", "unix_time_s", "link", "way", "message")


@dataclass(frozen=True)
class ReportFiles:
    """Files of a report by name, and descriptions of what is missing."""

    files: Mapping[str, str]
    missing: tuple[str, ...]


def collect(configs: Iterable[Path], *, socket: Path | None, home: Path) -> ReportFiles:
    """Collect a report; whatever is not available is listed as missing.

    configs: rig, layout and daemon files, with the files that a daemon's file names; socket: the
    daemon's, the default if None; home: the folder that is replaced by ~.
    """
    files: dict[str, str] = {}
    missing: list[str] = []
    named = [each for path in configs for each in _with_named(path, missing)]
    for path in {each.resolve(): each for each in named}.values():
        _include(path, files, missing)
    try:
        with Client.connect(socket, name="era report") as daemon:
            files["status.json"] = daemon.status().model_dump_json(indent=2)
    except (LinkError, RpcError) as error:
        missing.append(f"status of a daemon ({type(error).__name__})")
    return ReportFiles(
        {
            name: shown(text, home=home, is_dump=name.endswith(".jsonl"))
            for name, text in files.items()
        }
        | {"versions.json": json.dumps(versions(), indent=2)},
        tuple(missing),
    )


def write_zip(path: Path, report: ReportFiles) -> None:
    """Write a new file of mode 0600, completely or not at all.

    Raises InputError if it exists already or cannot be created, OSError if writing fails.
    """
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError as error:
        raise InputError(f"{path}: file exists already; choose another with -o") from error
    except OSError as error:
        raise InputError(f"{path}: cannot write: {error.strerror}") from error
    try:
        with (
            os.fdopen(descriptor, "wb") as stream,
            zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            for name, text in report.files.items():
                archive.writestr(name, text)
            archive.writestr("missing.txt", "".join(f"{line}\n" for line in report.missing))
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def versions() -> dict[str, Any]:
    """Versions of Python, the system, era-haptics and its dependencies, and all plug-ins."""
    dependencies = {}
    for name in _REQUIREMENT.findall("\n".join(requires("era-haptics") or ())):
        try:
            dependencies[name] = version(name)
        except PackageNotFoundError:
            dependencies[name] = "not installed"
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
        "packages": dict(sorted(dependencies.items())),
        "plug-ins": plug_ins,
    }


def _package(dist: Any) -> str:
    return f"{dist.name} {dist.version}" if dist is not None else "unknown"


def _with_named(path: Path, missing: list[str]) -> Iterable[Path]:
    """A configuration file, the files that it names, and the last dumps of a daemon."""
    yield path
    try:
        document = read_document(path)
    except InputError as error:
        if path.is_file():  # a missing file is reported when it is read
            missing.append(f"files that {path.name} names ({type(error).__name__})")
        return
    base = document.data.get("base")
    if isinstance(base, str) and "\0" not in base:
        yield document.beside(base)
    if not is_daemon_document(document):
        return
    layouts = document.data.get("layouts")
    names = layouts if isinstance(layouts, dict) else ()
    # A table is large and can be built again.
    rig = file_of(document, "rig")
    if rig is not None:
        yield from _with_named(rig, missing)
    yield from filter(None, (file_of(document, "layouts", each) for each in names))
    folder = file_of(document, "dumps", "folder")
    if folder is not None:
        dumps = sorted(folder.glob(DUMP_PATTERN), key=lambda file: file.name)
        yield from dumps[-MAX_DUMPS:]


def _include(path: Path, files: dict[str, str], missing: list[str]) -> None:
    """Include a text file under its name; of a large one only the end."""
    try:
        with open(path, "rb", opener=regular_file) as stream:
            stream.seek(max(0, path.stat().st_size - MAX_FILE_SIZE))
            text = stream.read(MAX_FILE_SIZE).decode("utf-8", errors="replace")
    except OSError as error:
        missing.append(f"{path.name}: {error.strerror}")
        return
    name = path.name
    while name in files:
        name = f"another-{name}"
    files[name] = text


def shown(text: str, *, home: Path, is_dump: bool = False) -> str:
    """Hide in a text the values of unknown keys, hosts and comments.

    home: the folder that is replaced by ~; is_dump: of messages on a link.
    """
    keys = (_keys_of_dumps() if is_dump else _keys_of_files()) - _PRIVATE

    def entry(found: re.Match[str]) -> str:
        key, separator, value = found.groups()
        return f"{key}{separator}{value if key in keys else _HIDDEN}"

    if home != home.parent:  # the home "/" of system users is part of every path
        text = text.replace(str(home), "~")
    text = _HOST.sub(_HIDDEN, _COMMENT.sub("", text))
    return _ENTRY.sub(entry, _PARAMETER.sub(entry, text))


@cache
def _keys_of_dumps() -> frozenset[str]:
    """Every field of the messages of amplifiers, and the keys of a line."""
    records = [EVENT_RECORD, IDENTITY, NAK_RECORD]
    for message in MESSAGES.values():
        records += (message.request, message.reply)
    return frozenset({*_OTHERS, "time_s"}.union(*map(_fields_of, records)))


def _fields_of(record: Record) -> set[str]:
    names = set(record.names)
    for field in record.fields:
        if isinstance(field, Rows):
            names |= _fields_of(field.record)
    return names


@cache
def _keys_of_files() -> frozenset[str]:
    """Every key of the files and of the status at any depth, and of URLs."""
    _, schema = models_json_schema([(each, "validation") for each in _OF_FILES])
    return frozenset(_OTHERS).union(_properties(schema))


def _properties(schema: dict[str, Any] | list[Any]) -> Iterator[str]:
    """Names of properties at any depth of a schema: one of several kinds has its own inside."""
    if isinstance(schema, dict):
        yield from schema.get("properties", ())
    for each in schema.values() if isinstance(schema, dict) else schema:
        if isinstance(each, dict | list):
            yield from _properties(each)
