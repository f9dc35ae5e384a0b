"""What may stand in a daemon's configuration: its sections, keys, defaults and bounds."""

import re
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, Strict

from controller.api.schema import MAX_LEASE, MIN_LEASE
from controller.loop.envelopes import ENVELOPE_TIME
from model.config.sections import Quantity, Section
from model.config.units import LENGTH, RATIO, TIME
from model.drive_modes import DRIVE_MODES
from model.finger.perception import STRONG_DB_SL
from model.rig.sections import Identifier

_NUMBER = Annotated[float, Quantity(RATIO, least=-10, most=10)]
_ROW = Annotated[tuple[_NUMBER, _NUMBER, _NUMBER], Strict(strict=False)]  # a list in the file

_LENGTH = Annotated[float, Quantity(LENGTH, least=-10, most=10)]
_POINT = Annotated[tuple[_LENGTH, _LENGTH], Strict(strict=False)]


def _mode(text: str) -> str:
    if text not in DRIVE_MODES:
        raise ValueError(f"{text[:40]!r} is no drive mode; choose {', '.join(DRIVE_MODES)}")
    return text


def _file(text: str) -> str:
    if "\0" in text:
        raise ValueError(f"{text[:40]!r} is no file's name: it holds a zero byte; leave that out")
    return text


def loopback_address(text: str) -> str:
    """The text if it is HOST:PORT on the loopback interface; ValueError for anything else."""
    match = re.fullmatch(r"(127\.0\.0\.1|localhost|\[::1\]):(\d{1,5})", text)
    if match is None or int(match[2]) > 65535:
        raise ValueError(
            f"{text[:40]!r} is no loopback address with a port, such as 127.0.0.1:8137; for others "
            "run the gateway by itself: era gateway --help"
        )
    return text


LONGEST_WAIT = 0.1
"""How long [s] a touch may wait for its shaped onset at most: later it is no answer to it."""

Port = Annotated[int, Field(ge=0, le=65535)]
File = Annotated[str, Field(min_length=1, max_length=4096), AfterValidator(_file)]
LevelDbSl = Annotated[float, Quantity(RATIO, least=-20, most=60)]


class CalibrationPoint(Section):
    """Where `era status` shows a finger without a calibration, and where it really is."""

    shown: _POINT
    at: _POINT


class CalibrationSection(Section):
    """How a sensor lies on the plate: turned clockwise, then mirrored; a matrix; or points."""

    turned: Literal[0, 90, 180, 270] = 0
    mirror: Literal["x", "y"] | None = None
    matrix: Annotated[tuple[_ROW, _ROW], Strict(strict=False)] | None = None
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
    """Where the last messages are written on a fault, and how many such files are kept."""

    folder: File
    keep: Annotated[int, Field(ge=1, le=1000)] = 20


class DaemonSection(Section):
    """A daemon's configuration; files count from the folder that it lies in."""

    rig: File
    table: File | None = None
    mode: Annotated[str, AfterValidator(_mode)] | None = None
    level_db_sl: LevelDbSl = STRONG_DB_SL
    touch_wait: Annotated[float, Quantity(TIME, least=0, most=LONGEST_WAIT)] = ENVELOPE_TIME
    layout: File | None = None
    touch: Annotated[list[TouchSection], Field(max_length=16, default_factory=list)]
    serial_numbers: Annotated[dict[Identifier, str], Field(max_length=64, default_factory=dict)]
    longest_lease: Annotated[float, Quantity(TIME, least=MIN_LEASE, most=MAX_LEASE)] = MAX_LEASE
    socket: File | None = None
    log: LogSection = LogSection()
    dumps: DumpSection | None = None
    metrics: Port | None = None
    dashboard: Annotated[str, AfterValidator(loopback_address)] | None = None
