"""Recordings of Linux touch panels in evemu's text format: multi-touch protocol type B (slots).

The format is evemu's (freedesktop.org, evemu-record(1)): a description of the device, then events
`E: seconds.micros type code value`, type and code in hexadecimal, value in decimal. What the events
mean is in the Linux kernel's Documentation/input/multi-touch-protocol.rst.
"""

import asyncio
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from controller.touch import Touch, TouchFrame, TouchSource
from model.errors import InputError

_EV_SYN, _EV_ABS = 0x00, 0x03
_SYN_REPORT, _SYN_MT_REPORT, _SYN_DROPPED = 0, 2, 3
_SLOT, _POSITION_X, _POSITION_Y, _TRACKING_ID = 0x2F, 0x35, 0x36, 0x39

_EVENT = re.compile(
    r"E: (\d{1,10}\.\d{1,6}) ([0-9a-fA-F]{1,4}) ([0-9a-fA-F]{1,4}) (-?\d{1,10})\s*(#.*)?"
)
_AXIS = re.compile(r"A: ([0-9a-fA-F]{1,2}) (-?\d{1,10}) (-?\d{1,10})( -?\d+)*\s*")
_COMMENT_CODE = re.compile(r"#\s+Event (?:code|type) (\d+) \((\w+)\)")
_COMMENT_VALUE = re.compile(r"#\s+(Value|Min|Max)\s+(-?\d{1,10})\s*")
_OTHER = re.compile(r"[A-Z]: .*|#.*|\s*")

# A panel at rest says nothing, but a contact without news counts as lifted.
_REPEAT = 0.05


@dataclass(frozen=True)
class _Event:
    """One event: when [s] on the recording's clock, and on which line it stands."""

    line: int
    time: float
    type: int
    code: int
    value: int


@dataclass
class _Slot:
    """What the recording has said of one slot; None where it has not.

    contact: the touch's id, None without a contact. certain: whether a tracking id said so; a
    slot that moves without one has had its contact since before the recording.
    """

    contact: int | None = None
    certain: bool = False
    x: float | None = None
    y: float | None = None


class _Panel:
    """The slots of a panel, from events to touches.

    A contact appears when both its coordinates are known. What a slot still knows of its last
    contact holds for the next one, since the kernel leaves out values that did not change.
    """

    def __init__(
        self, x_range: tuple[int, int], y_range: tuple[int, int], *, first_slot: int
    ) -> None:
        self._x_range = x_range
        self._y_range = y_range
        self._slots: dict[int, _Slot] = {}
        self._current = first_slot
        self._nameless = 0

    @property
    def touches(self) -> tuple[Touch, ...]:
        """All contacts whose place is known, by slot."""
        return tuple(
            Touch(slot.contact, slot.x, slot.y)
            for _, slot in sorted(self._slots.items())
            if slot.contact is not None and slot.x is not None and slot.y is not None
        )

    @property
    def slot(self) -> int:
        """The slot that the next event is about."""
        return self._current

    def forget(self) -> None:
        """Events were lost: no contact and no coordinate is sure any more."""
        self._slots.clear()

    def take(self, code: int, value: int) -> None:
        """Follow one EV_ABS event."""
        slot = self._slots.setdefault(self._current, _Slot())
        if code == _SLOT:
            self._current = value
        elif code == _TRACKING_ID:
            slot.contact = value if value >= 0 else None
            slot.certain = True
        elif code in (_POSITION_X, _POSITION_Y):
            if slot.contact is None and not slot.certain:
                self._nameless += 1
                slot.contact = -self._nameless  # tracking ids are never negative
            if code == _POSITION_X:
                slot.x = _share(value, self._x_range)
            else:
                slot.y = _share(value, self._y_range)


def _share(value: int, limits: tuple[int, int]) -> float:
    """Where a value lies in its axis' range, 0..1 within it."""
    low, high = limits
    return (value - low) / (high - low)


def read_evemu(path: Path | str) -> list[TouchFrame]:
    """Read a recording as one frame per report of the panel, times from 0 s at its first event.

    Axis ranges come from the recording's own header or, where it has none, from the .desc beside
    it. Contacts that were down before the recording began have negative ids; a contact that came
    and went within one report gets a frame of its own at the same time; after lost events
    (SYN_DROPPED) every contact counts as lifted. Raises InputError with file and line.
    """
    path = Path(path)
    header, events = _parse(path)
    for description in (path.with_suffix(".desc"), path.with_suffix("").with_suffix(".desc")):
        if description != path and description.is_file():
            # Its values are those of another moment than the recording's first.
            ranges = {
                key: limit for key, limit in _parse(description)[0].items() if key[1] != "Value"
            }
            header = ranges | header
    panel = _Panel(
        _axis(path, header, _POSITION_X, "ABS_MT_POSITION_X"),
        _axis(path, header, _POSITION_Y, "ABS_MT_POSITION_Y"),
        first_slot=header.get((_SLOT, "Value"), 0),
    )
    frames = _frames(path, events, panel)
    if not frames:
        raise InputError(f"{path}: no touch report in it; expected an evemu recording of a panel")
    return frames


def _frames(path: Path, events: list[_Event], panel: _Panel) -> list[TouchFrame]:
    """Frames of a recording's events."""
    frames: list[TouchFrame] = []
    pending: list[tuple[Touch, ...]] = []  # states within this report that would go unseen
    retold: set[int] = set()  # slots whose contact has changed within this report
    dropped = False
    for event in events:
        if (event.type, event.code) == (_EV_SYN, _SYN_MT_REPORT):
            raise InputError(
                f"{path}, line {event.line}: multi-touch protocol type A (SYN_MT_REPORT); "
                "only panels that report slots (type B) can be read"
            )
        if (event.type, event.code) == (_EV_SYN, _SYN_DROPPED):
            dropped = True
        elif (event.type, event.code) == (_EV_SYN, _SYN_REPORT):
            if dropped:  # what came since is a part of a report
                panel.forget()
                dropped = False
            time = event.time - events[0].time
            frames += [
                TouchFrame(f"evemu:{path.name}", time, touches)
                for touches in (*pending, panel.touches)
            ]
            pending, retold = [], set()
        elif event.type == _EV_ABS:
            if event.code == _SLOT and event.value < 0:
                raise InputError(f"{path}, line {event.line}: slot {event.value} is below zero")
            if event.code == _TRACKING_ID:
                if panel.slot in retold and not dropped:
                    pending.append(panel.touches)
                retold.add(panel.slot)
            panel.take(event.code, event.value)
    return frames


def _parse(path: Path) -> tuple[dict[tuple[int, str], int], list[_Event]]:
    """What the header says of an axis (its code, and Value, Min or Max) and all events."""
    header: dict[tuple[int, str], int] = {}
    events: list[_Event] = []
    code: int | None = None
    for number, line in _lines(path):
        if match := _EVENT.fullmatch(line):
            time, kind, event_code, value = match.group(1, 2, 3, 4)
            event = _Event(number, float(time), int(kind, 16), int(event_code, 16), int(value))
            if events and event.time < events[-1].time:
                raise InputError(f"{path}, line {number}: time runs backwards")
            events.append(event)
        elif line.startswith("E:"):
            raise InputError(
                f"{path}, line {number}: not an event: {line[:60]!r}; "
                "expected `E: seconds.micros type code value`"
            )
        elif match := _AXIS.fullmatch(line):
            axis = int(match.group(1), 16)
            header.setdefault((axis, "Min"), int(match.group(2)))
            header.setdefault((axis, "Max"), int(match.group(3)))
        elif match := _COMMENT_CODE.match(line):
            code = int(match.group(1)) if match.group(2).startswith("ABS_") else None
        elif (match := _COMMENT_VALUE.fullmatch(line)) and code is not None:
            header[code, match.group(1)] = int(match.group(2))
        elif not _OTHER.fullmatch(line):
            raise InputError(
                f"{path}, line {number}: {line[:60]!r} does not belong in an evemu recording"
            )
    return header, events


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines of a text file."""
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                yield number, line.rstrip("\r\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file, so no evemu recording") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def _axis(path: Path, header: dict[tuple[int, str], int], code: int, name: str) -> tuple[int, int]:
    """The range of an axis; raises InputError if the header does not say it."""
    try:
        low, high = header[code, "Min"], header[code, "Max"]
    except KeyError as error:
        raise InputError(
            f"{path}: the range of {name} is not in its header, nor in a .desc file beside it; "
            "record with evemu-record, which writes it, or put the device's .desc there"
        ) from error
    if low >= high:
        raise InputError(f"{path}: the range of {name} is {low} to {high}, which is none")
    return low, high


class EvemuSource(TouchSource):
    """Replays the recording at `evemu:PATH` at its own pace, on the event loop's clock.

    Ends with the recording; contacts that it leaves down are lifted then. Raises InputError.
    """

    def __init__(self, url: str) -> None:
        path = url.removeprefix("evemu:")
        if path == url or not path:
            raise InputError(f"touch source {url}: expected evemu:PATH of a recording (.events)")
        self.frames = read_evemu(path)

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver the recording's frames, each again every 50 ms while it has touches."""
        loop = asyncio.get_running_loop()
        start = loop.time()
        last = self.frames[-1]
        end = TouchFrame(last.source, last.time + (_REPEAT if last.touches else 0.0), ())
        current = TouchFrame(last.source, 0.0, ())
        for frame in (*self.frames, end):
            due = start + frame.time
            while current.touches and loop.time() + _REPEAT < due:
                await asyncio.sleep(_REPEAT)
                deliver(replace(current, time=loop.time()))
            await asyncio.sleep(max(0.0, due - loop.time()))
            current = frame
            deliver(replace(frame, time=loop.time()))
