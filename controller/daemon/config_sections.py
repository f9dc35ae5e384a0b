"""The schema of the daemon's configuration: sections, keys, defaults and bounds."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, Strict

from model.config.fields import LENGTH, LEVEL, Quantity, Section
from model.drive_modes import DRIVE_MODES
from model.finger import STRONG_DB_SL
from model.rig.actuator_keys import Identifier

MAX_LAYOUTS = 64

_LENGTH = Annotated[float, Quantity(LENGTH, at_least=-10, at_most=10)]
_POINT = Annotated[tuple[_LENGTH, _LENGTH], Strict(strict=False)]  # a list in the file


def _mode(text: str) -> str:
    if text not in DRIVE_MODES:
        raise ValueError(f"must be one of {', '.join(DRIVE_MODES)}, got {text[:40]!r}")
    return text


def _file(text: str) -> str:
    if "\0" in text:
        raise ValueError(f"file name must not contain a zero byte, got {text[:40]!r}")
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


File = Annotated[str, Field(min_length=1, max_length=4096), AfterValidator(_file)]
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
    file: File | None = None


class DumpSection(Section):
    """Folder of fault dumps."""

    folder: File


class DaemonSection(Section):
    """The daemon's configuration; paths are relative to its folder."""

    rig: File
    table: File | None = None
    mode: Annotated[str, AfterValidator(_mode)] | None = None
    learn: File | None = None
    level_db_sl: LevelDbSl = STRONG_DB_SL
    layouts: Annotated[dict[Identifier, File], Field(max_length=MAX_LAYOUTS, default_factory=dict)]
    strengths: File | None = None
    touch: Annotated[list[TouchSection], Field(max_length=16, default_factory=list)]
    serial_numbers: Annotated[dict[Identifier, str], Field(max_length=64, default_factory=dict)]
    socket: File | None = None
    log: LogSection = LogSection()
    dumps: DumpSection | None = None
    dashboard: Annotated[str, AfterValidator(loopback_address)] | None = None
