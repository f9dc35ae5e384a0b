"""Recordings of Linux touch panels in evemu's text format.

The format is evemu's (freedesktop.org, evemu-record(1)): a description of the device, then events
`E: seconds.micros type code value`, type and code in hexadecimal, value in decimal.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from controller.sources.playing import play, with_lifts
from controller.sources.recording import recorded_lines
from controller.sources.slots import (
    ABS_MT_POSITION_X,
    ABS_MT_POSITION_Y,
    ABS_MT_PRESSURE,
    ABS_MT_SLOT,
    ABS_MT_TOUCH_MAJOR,
    EventError,
    SlotReader,
    light_press,
)
from controller.sources.touch import TouchFrame, TouchSource
from controller.sources.url_options import panel_options
from model.errors import InputError

_EVENT = re.compile(
    r"E: (\d{1,10}\.\d{1,6}) ([0-9a-fA-F]{1,4}) ([0-9a-fA-F]{1,4}) (-?\d{1,10})\s*(#.*)?"
)
_AXIS = re.compile(
    r"A: ([0-9a-fA-F]{1,2}) (-?\d{1,10}) (-?\d{1,10})(?: -?\d+ -?\d+ (-?\d{1,10}))?( -?\d+)*\s*"
)
_COMMENT_CODE = re.compile(r"#\s+Event (?:code|type) (\d+) \((\w+)\)")
_COMMENT_VALUE = re.compile(r"#\s+(Value|Min|Max|Resolution)\s+(-?\d{1,10})\s*")
_OTHER = re.compile(r"[A-Z]: .*|#.*|\s*")


@dataclass(frozen=True)
class _Event:
    """One event with its line, and its time [s] by the clock of the recording."""

    line: int
    time: float
    type: int
    code: int
    value: int


def read_evemu(
    path: Path | str, *, light_values: Mapping[int, float] = MappingProxyType({})
) -> list[TouchFrame]:
    """Read a recording as one frame per report of the panel, times from 0 s at its first event.

    Axis ranges come from the header of the recording, else from the .desc file beside it. Contacts
    that were down before it started have negative ids; a contact that comes and goes within one
    report gets a frame of its own at the same time; lost events (SYN_DROPPED) lift every contact.
    light_values: of axes under a finger that presses lightly, where their resolution does not tell.
    Raises InputError with file and line.
    """
    path = Path(path)
    header, events = _parse(path)
    for description in (path.with_suffix(".desc"), path.with_suffix("").with_suffix(".desc")):
        if description != path and description.is_file():
            # Its values are not those at the start of the recording.
            ranges = {
                key: limit for key, limit in _parse(description)[0].items() if key[1] != "Value"
            }
            header = ranges | header
    limits = {
        ABS_MT_POSITION_X: _axis(path, header, ABS_MT_POSITION_X, "ABS_MT_POSITION_X"),
        ABS_MT_POSITION_Y: _axis(path, header, ABS_MT_POSITION_Y, "ABS_MT_POSITION_Y"),
    }
    for axis in (ABS_MT_PRESSURE, ABS_MT_TOUCH_MAJOR):
        low, high = header.get((axis, "Min"), 0), header.get((axis, "Max"), 0)
        if low < high:
            limits[axis] = (low, high)
    resolutions = {axis: header.get((axis, "Resolution"), 0) for axis in limits}
    reader = SlotReader(
        limits,
        first_slot=header.get((ABS_MT_SLOT, "Value"), 0),
        light_press=light_press(resolutions, light_values),
    )
    frames = _frames(path, events, reader)
    if not frames:
        raise InputError(f"{path}: must be an evemu recording with touch reports; record it again")
    return frames


def _frames(path: Path, events: list[_Event], reader: SlotReader) -> list[TouchFrame]:
    """Convert the events of a recording to frames."""
    frames: list[TouchFrame] = []
    for event in events:
        try:
            report = reader.feed(event.type, event.code, event.value)
        except EventError as error:
            raise InputError(f"{path}, line {event.line}: {error}") from error
        if report is not None:
            time = event.time - events[0].time
            frames += [TouchFrame(f"evemu:{path.name}", time, touches) for touches in report.states]
    return frames


def _parse(path: Path) -> tuple[dict[tuple[int, str], int], list[_Event]]:
    """Return the header (axis code and Value, Min or Max) and all events."""
    header: dict[tuple[int, str], int] = {}
    events: list[_Event] = []
    code: int | None = None
    for number, line in enumerate(recorded_lines(path, what="an evemu recording"), start=1):
        if match := _EVENT.fullmatch(line):
            time, kind, event_code, value = match.group(1, 2, 3, 4)
            event = _Event(number, float(time), int(kind, 16), int(event_code, 16), int(value))
            if events and event.time < events[-1].time:
                raise InputError(f"{path}, line {number}: times must not decrease")
            events.append(event)
        elif line.startswith("E:"):
            raise InputError(
                f"{path}, line {number}: event must be `E: seconds.micros type code value`, got "
                f"{line[:60]!r}"
            )
        elif match := _AXIS.fullmatch(line):
            axis = int(match.group(1), 16)
            header.setdefault((axis, "Min"), int(match.group(2)))
            header.setdefault((axis, "Max"), int(match.group(3)))
            header.setdefault((axis, "Resolution"), int(match.group(4) or 0))
        elif match := _COMMENT_CODE.match(line):
            code = int(match.group(1)) if match.group(2).startswith("ABS_") else None
        elif (match := _COMMENT_VALUE.fullmatch(line)) and code is not None:
            header[code, match.group(1)] = int(match.group(2))
        elif not _OTHER.fullmatch(line):
            raise InputError(
                f"{path}, line {number}: must be a line of an evemu recording, got {line[:60]!r}"
            )
    return header, events


def _axis(path: Path, header: dict[tuple[int, str], int], code: int, name: str) -> tuple[int, int]:
    """Return the range of an axis; raises InputError if the header lacks it."""
    try:
        low, high = header[code, "Min"], header[code, "Max"]
    except KeyError as error:
        raise InputError(
            f"{path}: range of {name} is missing in the header and in a .desc file beside it; "
            "record with evemu-record, which writes it, or add the .desc file of the device"
        ) from error
    if low >= high:
        raise InputError(
            f"{path}: minimum of {name} must be below its maximum, got {low} and {high}"
        )
    return low, high


class EvemuSource(TouchSource):
    """Replays the recording at `evemu:PATH` at its pace, on the event loop's clock.

    `?light_pressure=VALUE` and `?light_major=VALUE` as those of `EvdevSource`.
    Ends with the recording and lifts the remaining contacts. Raises InputError.
    """

    def __init__(self, url: str) -> None:
        path, _, options = url.removeprefix("evemu:").partition("?")
        others, light_values = panel_options(options)
        if not url.startswith("evemu:") or not path or others:
            raise InputError(
                "touch source must be evemu:PATH of a recording (.events), with "
                f"?light_pressure=VALUE and ?light_major=VALUE, got {url}"
            )
        self.frames = with_lifts(read_evemu(path, light_values=light_values))

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver the frames of the recording at its pace."""
        await play(self.frames, deliver)
