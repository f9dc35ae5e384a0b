"""The daemon's configuration: sections, keys, defaults and bounds, and how its files are loaded.

`DaemonSection` is the schema of the file, `DaemonConfig` the validated configuration with its rig
and layouts. All problems of a file are reported together, each with its key and line.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, Strict

from controller.config_kind import CheckedFile, ConfigKind
from controller.effects.layout import (
    SurfaceLayout,
    default_effects,
    is_layout_document,
    level_problem,
    load_layout,
)
from controller.effects.strengths import read_strengths
from controller.process.daemon_process import check_socket_path
from controller.rig_file_check import clock_costs, whole_url
from controller.sources.touch import TouchSource, open_source
from controller.sources.touch_calibration import TouchCalibration, fit_touch_calibration, turned
from drivers.by_hand.links import check_links
from model.arrays import FloatArray
from model.config.document import ConfigError, Document, is_file_name, read_document
from model.config.fields import FileName, Quantity, Section, Validation
from model.config.units import LENGTH, LEVEL
from model.drive_modes import DRIVE_MODES
from model.errors import InputError
from model.finger import STRONG_DB_SL
from model.rig.key_types import Identifier
from model.rig.rig import Rig
from model.rig.rig_file import rig_of, with_base
from model.rig.rig_warnings import gain_notes
from model.structure.statics import check_supported
from registry.limits import MAX_CONTACTS, MAX_FINGERS

MAX_LAYOUTS = 64

_LENGTH = Annotated[float, Quantity(LENGTH, at_least=-10, at_most=10)]
_POINT = Annotated[tuple[_LENGTH, _LENGTH], Strict(strict=False)]  # a list in the file


def _mode(text: str) -> str:
    if text not in DRIVE_MODES:
        raise ValueError(f"must be one of {', '.join(DRIVE_MODES)}, got {text[:40]!r}")
    return text


def loopback_address(text: str) -> str:
    """Return HOST:PORT on the loopback interface unchanged; raises ValueError otherwise."""
    match = re.fullmatch(r"(127\.0\.0\.1|localhost|\[::1\]):(\d{1,5})", text)
    if match is None or int(match[2]) > 65535:
        raise ValueError(
            f"must be a loopback address with a port, such as 127.0.0.1:8137, got {text[:40]!r}; "
            "for other addresses run era gateway separately"
        )
    return text


LevelDbSl = Annotated[float, Quantity(LEVEL, at_least=-20, at_most=60)]


class CalibrationPoint(Section):
    """A touched point: as shown by `era status` without calibration, and its true position."""

    shown: _POINT
    at: _POINT


class CalibrationSection(Section):
    """The sensor's orientation: turned clockwise, then mirrored; or touched points."""

    turned: Literal[0, 90, 180, 270] = 0
    mirror: Literal["x", "y"] | None = None
    points: Annotated[list[CalibrationPoint], Field(min_length=3, max_length=64)] | None = None


class TouchSection(Section):
    """One touch source."""

    name: Identifier
    url: Annotated[str, Field(min_length=1, max_length=4096)]
    calibration: CalibrationSection = CalibrationSection()


class LogSection(Section):
    """The log: JSON, one object a line, to standard error or a file."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    file: FileName | None = None


class DaemonSection(Section):
    """The daemon's configuration; paths are relative to its folder."""

    rig: FileName
    table: FileName | None = None
    mode: Annotated[str, AfterValidator(_mode)] | None = None
    level_db_sl: LevelDbSl = STRONG_DB_SL
    layouts: Annotated[
        dict[Identifier, FileName], Field(max_length=MAX_LAYOUTS, default_factory=dict)
    ]
    strengths: FileName | None = None
    touch: Annotated[list[TouchSection], Field(max_length=16, default_factory=list)]
    max_fingers: Annotated[int, Field(ge=1, le=MAX_CONTACTS)] = MAX_FINGERS
    serial_numbers: Annotated[dict[Identifier, str], Field(max_length=64, default_factory=dict)]
    socket: FileName | None = None
    log: LogSection = LogSection()
    dashboard: Annotated[str, AfterValidator(loopback_address)] | None = None


API_SOURCES = "api"
"""Prefix of the touch sources of API clients, reserved for them."""


@dataclass(frozen=True)
class TouchInput:
    """A configured touch source, not yet created."""

    name: str
    url: str
    calibration: TouchCalibration

    def make(self) -> TouchSource:
        """Create the source, in its own coordinates; raises InputError."""
        return open_source(self.url)


@dataclass(frozen=True)
class DaemonConfig:
    """A validated configuration."""

    source: Path
    section: DaemonSection
    rig: Rig
    rig_text: str
    """Content of the rig's file."""
    urls: Mapping[str, str]
    """URL of each amplifier by name."""
    table: Path | None
    """File of the localization table; None: build it or use the cache."""
    layouts: Mapping[str | None, SurfaceLayout]
    """Layouts by name, in the order of the file; without layouts, one named None that buzzes at
    every touch."""
    strengths: Path | None
    """File in which strengths are kept; None: they last as long as the daemon runs."""
    touch: tuple[TouchInput, ...]
    socket: Path
    log_file: Path | None

    @property
    def touch_position(self) -> float:
        """RMS distance [m] of fingers from the positions that the worst touch source reports.

        The value in the rig file, if there is one; otherwise from the calibration of the sources.
        """
        default = self.rig.uncertainty.touch_position
        document = self.rig.document
        stated = document.data.get("uncertainty") if document else None
        if isinstance(stated, dict) and "touch_position" in stated:
            return default
        distances = [source.calibration.touch_position(default) for source in self.touch]
        return max(distances, default=default)

    def for_table(self, frequencies: FloatArray) -> Self:
        """Return a copy whose layouts are rendered for the frequencies of a table [Hz]."""
        layouts = {}
        for name, layout in self.layouts.items():
            layouts[name] = layout.for_table(frequencies)
        return replace(self, layouts=layouts)


def load_daemon_config(path: Path) -> DaemonConfig:
    """Load a daemon's file with its rig and layouts; raises ConfigError with all problems."""
    return daemon_config_of(read_document(path))


def daemon_config_of(document: Document) -> DaemonConfig:
    """Load the files that a daemon file names; raises the errors of `load_daemon_config`."""
    from controller.api.link import default_socket  # not on Windows, where rigs are checked

    _check_kind(document)
    validation = Validation(document, DaemonSection)
    rig_file = file_of(document, "rig")
    rig, rig_text = _rig(validation, rig_file)
    urls = _urls(validation, rig, rig_file)
    touch = _touch(validation, document, rig)
    table = file_of(document, "table")
    if table is not None and not table.is_file():
        validation.add(("table",), f"file not found: {table}; check name and folder")
    layouts = _layouts(validation, document, rig)
    _check_serial_numbers(validation, rig)
    log_file = file_of(document, "log", "file")
    strengths = file_of(document, "strengths")
    _check_log(validation, log_file)
    try:
        read_strengths(strengths)
    except InputError as error:
        validation.add(("strengths",), str(error))
    if strengths is not None:
        _check_folder_of(validation, strengths, "strengths")
    socket = file_of(document, "socket") or default_socket()
    try:
        check_socket_path(socket)
    except (InputError, OSError) as error:
        validation.add(("socket",), str(error))
    section = validation.finish()
    assert rig is not None  # noqa: S101  else a problem was reported
    return DaemonConfig(
        source=Path(document.source),
        section=section,
        rig=rig,
        rig_text=rig_text,
        urls=urls,
        table=table,
        layouts=layouts,
        strengths=strengths,
        touch=touch,
        socket=socket,
        log_file=log_file,
    )


def is_daemon_document(document: Document) -> bool:
    """Whether a document is a daemon file: it has daemon keys and describes no plate."""
    keys = document.data.keys()
    return bool(keys & DaemonSection.model_fields.keys()) and keys.isdisjoint({"plate", "surface"})


def _check_kind(document: Document) -> None:
    """Reject another kind of file as a whole instead of reporting each unknown key."""
    if "rig" in document.data:
        return
    if is_layout_document(document):
        kind = "surface layout"
        entry = "layouts: {NAME: FILE}"
    elif not {"plate", "surface"}.isdisjoint(document.data):
        kind = "rig"
        entry = "rig: FILE"
    else:
        return
    raise InputError(
        f"{document.source}: must be a daemon's file, got a {kind}; write a daemon's file that "
        f"contains {entry} (era config init daemon.yaml --kind daemon)"
    )


def file_of(document: Document, *keys: str) -> Path | None:
    """Return the path at nested keys, relative to the file's folder; None if it is missing."""
    value: object = document.data
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return document.beside(value) if is_file_name(value) else None


def _rig(validation: Validation[DaemonSection], file: Path | None) -> tuple[Rig | None, str]:
    """Load the rig and its text; problems are reported at the key that names it."""
    if file is None:
        return None, ""
    try:
        document = with_base(read_document(file))
        rig = rig_of(document)
        check_supported(rig.plate, rig.eras, loads=rig.masses)
        assert rig.document is not None  # noqa: S101  the rig was loaded from a document
        return rig, rig.document.whole_text
    except ConfigError as error:
        validation.add(("rig",), "invalid rig:\n    " + str(error).replace("\n", "\n  "))
    except (InputError, OSError) as error:
        validation.add(("rig",), f"invalid rig: {error}")
    return None, ""


def _layouts(
    validation: Validation[DaemonSection], document: Document, rig: Rig | None
) -> dict[str | None, SurfaceLayout]:
    """Load the surface layouts; problems are reported at the keys that name them."""
    level = validation.field(("level_db_sl",), DaemonSection)
    if level is None:
        level = STRONG_DB_SL
    plate = None if rig is None else rig.plate
    layouts: dict[str | None, SurfaceLayout] = {}
    for name in islice(validation.mapping(("layouts",)), MAX_LAYOUTS):
        file = file_of(document, "layouts", name)
        try:
            if file is not None:
                layouts[name] = load_layout(file, plate, level_db_sl=level)
        except InputError as error:
            indented = str(error).replace("\n", "\n  ")
            validation.add(("layouts", name), f"invalid layout:\n    {indented}")
    if layouts:
        return layouts
    problem = level_problem(level)
    if problem:
        validation.add(("level_db_sl",), problem)
    return {None: SurfaceLayout(effects=default_effects(level))}


def _urls(
    validation: Validation[DaemonSection], rig: Rig | None, rig_file: Path | None
) -> dict[str, str]:
    """The URL of each amplifier; `sim://` becomes a simulated one under this rig's plate."""
    if rig is None or rig_file is None:
        return {}
    urls = {name: whole_url(url, rig_file.resolve(), name) for name, url in rig.amplifiers.items()}
    errors, _ = check_links(urls, channels=rig.channel_counts, limits=rig.limits)
    for name, error in errors.items():
        validation.add(("rig",), f"invalid amplifiers.{name}.url of the rig: {error}")
    simulated = [name for name, url in urls.items() if url.startswith("sim://")]
    if 0 < len(simulated) < len(urls):
        validation.add(
            ("rig",),
            "sim:// must be the URL of all amplifiers or of none; run era sim RIG --serial and put "
            "the URLs that it prints into the rig",
        )
    return urls


def _touch(
    validation: Validation[DaemonSection], document: Document, rig: Rig | None
) -> tuple[TouchInput, ...]:
    """Return the valid touch sources; each is created once to check its URL."""
    entries = document.data.get("touch")
    if not isinstance(entries, list):
        return ()
    inputs = {}
    for number, entry in enumerate(entries):
        try:
            section = TouchSection.model_validate(entry)
        except ValueError:
            continue  # reported by the validation
        name = section.name
        if name in inputs:
            validation.add(("touch", number, "name"), f"name must be unique, got {name} twice")
            continue
        if name == API_SOURCES:
            validation.add(
                ("touch", number, "name"),
                f"name must not be {API_SOURCES}, which is reserved for API clients",
            )
        try:
            calibration = _calibration(section.calibration, rig)
        except InputError as error:
            validation.add(("touch", number, "calibration"), str(error))
            continue
        inputs[name] = TouchInput(name, section.url, calibration)
        try:
            inputs[name].make()
        except InputError as error:
            validation.add(("touch", number, "url"), str(error))
    return tuple(inputs.values())


def _calibration(section: CalibrationSection, rig: Rig | None) -> TouchCalibration:
    if section.points is not None and (section.turned or section.mirror):
        raise InputError("must have only one of turned and mirror, points")
    if section.points is None or rig is None:  # an invalid rig is already reported
        return turned(section.turned, mirror=section.mirror)
    plate = rig.plate
    shown_positions = []
    for point in section.points:
        x, y = point.shown
        shown_positions.append((x / plate.length, 1 - y / plate.width))
    true_positions = [point.at for point in section.points]
    return fit_touch_calibration(shown_positions, true_positions, plate)


def _check_log(validation: Validation[DaemonSection], log: Path | None) -> None:
    """Check the path of the log, whose folder must exist."""
    if log is None:
        return
    if log.is_dir():
        validation.add(("log", "file"), f"must be a file, got the folder {log}")
    else:
        _check_folder_of(validation, log, "log", "file")


def _check_folder_of(validation: Validation[DaemonSection], file: Path, *keys: str) -> None:
    """Check that the folder of a file that is written later exists."""
    if not file.parent.is_dir():
        validation.add(keys, f"folder not found: {file.parent}; create it")


def _check_serial_numbers(validation: Validation[DaemonSection], rig: Rig | None) -> None:
    if rig is None:
        return
    for name in validation.mapping(("serial_numbers",)):
        if name not in rig.amplifiers:
            validation.add(
                ("serial_numbers", name),
                f"unknown amplifier; the rig has {', '.join(rig.amplifiers)}",
            )


def _checked(document: Document) -> CheckedFile:
    """Check a file and the files that it names; return a one-line summary."""
    config = daemon_config_of(document)
    rig = config.rig
    _, warnings = check_links(config.urls, channels=rig.channel_counts, limits=rig.limits)
    eras = ", ".join(era.name for era in rig.eras)
    amplifiers = ", ".join(f"{name} ({url})" for name, url in config.urls.items())
    sources = ", ".join(source.name for source in config.touch) or "the API only"
    line = f"good: ERAs {eras} on {amplifiers}; touches from {sources}; socket {config.socket}"
    if config.table is not None:
        line += f". era daemon {document.source} --check also reads its table"
    clock_line, clock_warnings, clock_data = clock_costs(rig, config.urls)
    notes = [*warnings, *clock_warnings, *gain_notes(rig), *rig.surface_notes]
    if rig.uncertainty_note:
        notes.append(rig.uncertainty_note)
    return CheckedFile(line + clock_line, notes, clock_data)


DAEMON = ConfigKind(
    "A daemon of era-haptics",
    recognises=is_daemon_document,
    check=_checked,
    example_file=Path(__file__).with_name("example.yaml"),
    keys=DaemonSection.model_json_schema,
)
