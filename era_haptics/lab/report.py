"""`era report`: collect what a bug report needs in one folder.

The folder has versions, configuration, the daemon's status, the end of its log and its fault dumps.
Values of keys of a configuration that this program does not know are hidden, and everywhere those
of keys that name a secret. Free text, as in causes and names, is not searched: look at the files
before you send them.
"""

import json
import platform
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import distributions, entry_points, version
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
from model.config.document import read_document
from model.errors import InputError
from model.rig.sections import RigSection
from registry.files import regular_file
from registry.plugins import plugins_of

MAX_FILE_SIZE = 1 << 20  # bytes; of a larger file only the end is included
MAX_DUMPS = 5
_GROUPS = "era_haptics."  # prefix of our entry point groups
_COMMENT = re.compile(r"(?m)(?:^|(?<=\s))#.*$")
_HOST = re.compile(r"(?<=://)[^/?#\s\"']+")
_PARAMETER = re.compile(r"""(?<![\w-])([\w-]++)(=)([^\s,&#}"']+)""")  # of a URL
_ENTRY = re.compile(
    r"""(?<![\w-])([\w-]++)(["']?[ \t]*:[ \t]*)(?!//)"""
    r"""("[^"\n]*"|'[^'\n]*'|[^\s,{}\[\]"'][^\n,{}\[\]"']*)"""
)  # of YAML or JSON
_SECRET = re.compile(r"(?i)key|\blease\b|pass|\bpin\b|secret|serial_number|token|user")

_HIDDEN = "hidden"

_OF_FILES = (RigSection, DaemonSection, LayoutSection, StatusResult)
_OTHERS = ("baud", "bitrate", "timeout")


def collect(
    configs: Iterable[Path], *, socket: Path | None, home: Path
) -> tuple[dict[str, str], list[str]]:
    """Collect the files of a report, by name, and descriptions of what is missing.

    configs: rig, layout and daemon files, with the files, the log and the dumps that a daemon's
    file names; socket: the daemon's, the default if None; home: the folder that is replaced by ~.
    """
    files: dict[str, str] = {}
    missing: list[str] = []
    found = [each for path in configs for each in _with_named(path, missing)]
    for path, is_recorded in {path.resolve(): (path, is_own) for path, is_own in found}.values():
        try:
            text = _end_of(path)
        except OSError as error:
            missing.append(f"{path.name}: {error.strerror}")
            continue
        name = path.name
        while name in files:
            name = f"another-{name}"
        files[name] = shown(text, home=home, is_recorded=is_recorded)
    try:
        with Client.connect(socket, name="era report") as daemon:
            status = daemon.status().model_dump_json(indent=2)
        files["status.json"] = shown(status, home=home)
    except (LinkError, RpcError) as error:
        missing.append(f"status of a daemon ({type(error).__name__})")
    files["versions.json"] = json.dumps(versions(), indent=2)
    return files, missing


def write_report(folder: Path, files: Mapping[str, str], missing: Iterable[str]) -> None:
    """Write a new folder of mode 0700, completely or not at all; arguments as `collect` returns.

    Raises InputError if it exists already or cannot be created, OSError if writing fails.
    """
    try:
        folder.mkdir(mode=0o700)
    except FileExistsError as error:
        raise InputError(f"{folder}: exists already; choose another with -o") from error
    except OSError as error:
        raise InputError(f"{folder}: cannot write: {error.strerror}") from error
    lines = "".join(f"{line}\n" for line in missing)
    try:
        for name, text in {**files, "missing.txt": lines}.items():
            (folder / name).write_text(text, "utf-8")
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def versions() -> dict[str, Any]:
    """Versions of Python, the system, era-haptics and all installed packages, and all plug-ins."""
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
        "packages": dict(sorted((each.name, each.version) for each in distributions())),
        "plug-ins": plug_ins,
    }


def _package(dist: Any) -> str:
    return f"{dist.name} {dist.version}" if dist is not None else "unknown"


def _with_named(path: Path, missing: list[str]) -> Iterator[tuple[Path, bool]]:
    """Yield a configuration file, and the files that it names: for a daemon log and last dumps too.

    Each with whether this program recorded it.
    """
    yield path, False
    try:
        document = read_document(path)
    except InputError as error:
        if path.is_file():  # a missing file is reported when it is read
            missing.append(f"files that {path.name} names ({type(error).__name__})")
        return
    base = document.data.get("base")
    if isinstance(base, str) and "\0" not in base:
        yield document.beside(base), False
    if not is_daemon_document(document):
        return
    layouts = document.data.get("layouts")
    # A table is large and can be built again.
    if (rig := file_of(document, "rig")) is not None:
        yield from _with_named(rig, missing)
    for name in layouts if isinstance(layouts, dict) else ():
        if (layout := file_of(document, "layouts", name)) is not None:
            yield layout, False
    if (log := file_of(document, "log", "file")) is not None:
        yield log, True
    if (folder := file_of(document, "dumps", "folder")) is not None:
        dumps = sorted(folder.glob(DUMP_PATTERN), key=lambda file: file.name)
        yield from ((each, True) for each in dumps[-MAX_DUMPS:])


def _end_of(path: Path) -> str:
    """Return a text file, of a large one only the end. Raises OSError."""
    with open(path, "rb", opener=regular_file) as stream:
        stream.seek(max(0, path.stat().st_size - MAX_FILE_SIZE))
        return stream.read(MAX_FILE_SIZE).decode("utf-8", errors="replace")


def shown(text: str, *, home: Path, is_recorded: bool = False) -> str:
    """Hide in a text the values of unknown keys, hosts and comments.

    home: the folder that is replaced by ~; is_recorded: of a log or a dump, whose keys are this
    program's own: only those that name a secret are hidden.
    """

    def entry(found: re.Match[str]) -> str:
        key, separator, value = found.groups()
        is_hidden = _SECRET.search(key) or not (is_recorded or key in _known_keys())
        return f"{key}{separator}{_HIDDEN if is_hidden else value}"

    if home != home.parent:  # the home "/" of system users is part of every path
        text = text.replace(str(home), "~")
    text = _HOST.sub(_HIDDEN, text if is_recorded else _COMMENT.sub("", text))
    return _ENTRY.sub(entry, _PARAMETER.sub(entry, text))


@cache
def _known_keys() -> frozenset[str]:
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
