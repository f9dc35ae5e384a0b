"""Touch panels that are read from the kernel's input devices, with a pipe in place of the device.

Events are worked out by hand from the kernel's multi-touch protocol, type B.
"""

import asyncio
import contextlib
import errno
import os
import struct
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.sources.evdev import EvdevSource
from controller.sources.input_device import (
    CLOCK,
    GRAB,
    PRESSED_KEYS,
    InputDevice,
    InputEvent,
    as_slot_event,
    eviocgabs,
    eviocgmtslots,
    parse_events,
)
from controller.sources.slot_reader import SlotReader, SlotState
from controller.sources.touch import TouchFrame
from kit.clock import run_virtual
from model.errors import InputError
from registry import threads
from registry.limits import HAND_LOAD
from registry.virtual_time import START

EMPTY = SlotState(-1, 0, 0)
KINDS = {
    **{"slot": (3, 0x2F), "id": (3, 0x39), "x": (3, 0x35), "y": (3, 0x36)},
    **{"tool": (3, 0x37), "distance": (3, 0x3B), "pressure": (3, 0x3A), "major": (3, 0x30)},
}


def raw(words: str, *, dropped: bool = False, at: float = 0.0) -> bytes:
    """A report such as "slot 0 id 7 x 100 y 50" as struct input_event has it on x86-64 and Arm.

    at: its time [s].
    """
    pairs = words.split()
    events = [(*KINDS[key], int(value)) for key, value in zip(pairs[::2], pairs[1::2], strict=True)]
    events += [(0, 3, 0)] * dropped + [(0, 0, 0)]
    return b"".join(struct.pack("@qqHHi", int(at), round(at % 1 * 1e6), *event) for event in events)


class PipePanel:
    """A panel of 1000 by 500 with two slots, whose events come through a pipe."""

    def __init__(self) -> None:
        self.ranges = {0x35: (0, 1000), 0x36: (0, 500), 0x3A: (0, 255)}
        self.resolutions: dict[int, int] = {}
        self.current_slot = 0
        self.state = {0: EMPTY, 1: EMPTY}
        self.error: OSError | None = None
        self._out, self.into = os.pipe()
        os.set_blocking(self._out, False)

    def fileno(self) -> int:
        """Return the pipe's read end."""
        return self._out

    def slots(self) -> dict[int, SlotState]:
        """Return the state that a test has set."""
        if self.error:
            raise self.error
        return self.state

    def read(self) -> list[InputEvent]:
        """Return the events in the pipe."""
        if self.error:
            raise self.error
        try:
            return list(parse_events(os.read(self._out, 4096)))
        except BlockingIOError:
            return []

    def close(self) -> None:
        """Close both ends."""
        os.close(self._out)
        os.close(self.into)


Happens: TypeAlias = bytes | float | Mapping[int, SlotState] | OSError
"""Bytes that a panel sends, a time [s] that passes, or a state or an error of it from then on."""


def delivered(panel: PipePanel, *happens: Happens, options: str = "") -> list[TouchFrame]:
    """What a source delivers [s from the start] while things happen; options: of its URL.

    An exception that the source raises is raised here.
    """
    seen: list[TouchFrame] = []

    async def follow() -> None:
        start = threads.now()

        def deliver(frame: TouchFrame) -> None:
            assert frame.source == "evdev:p"
            seen.append(replace(frame, time=round(frame.time - start, 6)))

        source = EvdevSource(f"evdev:p{options}", open_panel=lambda path, *, grab: panel)
        running = asyncio.create_task(source.run(deliver))
        await asyncio.sleep(0)
        for each in happens:
            if isinstance(each, bytes):
                os.write(panel.into, each)
            elif isinstance(each, Mapping):
                panel.state = {0: EMPTY, 1: EMPTY, **each}
            elif isinstance(each, OSError):
                panel.error = each
            else:
                await asyncio.sleep(each)
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running

    run_virtual(follow())
    return seen


def spaced(seconds: float, *reports: str) -> list[Happens]:
    """Reports, each followed by a time [s]."""
    return [each for words in reports for each in (raw(words), seconds)]


def touches_of(frames: Iterable[TouchFrame]) -> list[dict[int, tuple[float, float]]]:
    """The touches of each frame."""
    return [{touch.id: (touch.x, touch.y) for touch in frame.touches} for frame in frames]


def test_evdev_source_follows_fingers() -> None:
    """Each report is a frame, in shares of the panel's axes, y downwards as the kernel counts.

    Fingers on the panel when it is opened are delivered at once, with the slot of the next event;
    after SYN_DROPPED the kernel's state counts, as its documentation demands.
    """
    panel = PipePanel()
    panel.state = {0: EMPTY, 1: SlotState(5, 500, 250)}
    panel.current_slot = 1
    reports = spaced(0.01, "x 600", "slot 0 id 7 x 250 y 100", "x 300", "slot 1 id -1")
    dropped = raw("slot 0 x 900", dropped=True)
    assert touches_of(delivered(panel, *reports, {1: SlotState(9, 1000, 0)}, dropped, 0.01)) == [
        {5: (0.5, 0.5)},
        {5: (0.6, 0.5)},
        {5: (0.6, 0.5), 7: (0.25, 0.2)},
        {5: (0.6, 0.5), 7: (0.3, 0.2)},
        {7: (0.3, 0.2)},
        {9: (1.0, 0.0)},
    ]


def test_evdev_source_repeats_resting_fingers() -> None:
    """The kernel's state is polled every 50 ms, well within the contact timeout of 150 ms.

    A lift without an event is noticed then.
    """
    landed = raw("id 7 x 0 y 0")
    seen = delivered(PipePanel(), landed, {0: SlotState(7, 0, 0)}, 0.12, {}, 0.2)
    assert [frame.time for frame in seen] == [0.0, 0.0, 0.05, 0.1, 0.15]
    assert touches_of(seen) == [{}, *[{7: (0.0, 0.0)}] * 3, {}]


def test_evdev_source_knows_palms_and_no_pens() -> None:
    """Pens and what hovers are no touches, palms have a hand's load, by events and by polling.

    Tools 1 and 2 are a pen and a palm in the kernel's input-event-codes.h; a distance above zero is
    a hovering contact, by its multi-touch-protocol.rst.
    """
    panel = PipePanel()
    panel.state = {0: SlotState(5, 500, 250, tool=2), 1: SlotState(6, 500, 250, distance=3)}
    reports = spaced(
        0.001,
        *("slot 0 tool 0", "tool 2", "tool 1", "slot 1 distance 0", "distance 1"),
        *("id -1 slot 0 id -1", "id 7 tool 2 x 250 y 100", "id 8", "id 9 tool 0"),
    )
    middle, corner = (0.5, 0.5), (0.25, 0.2)
    seen = delivered(panel, *reports, {0: SlotState(9, 250, 100, tool=2)}, 0.05)
    assert touches_of(seen) == [
        {5: middle},
        *({5: middle}, {5: middle}, {}, {6: middle}, {}),
        *({}, {7: corner}, {8: corner}, {9: corner}),
        {9: corner},
    ]
    loads = [touch.load for frame in seen for touch in frame.touches]
    assert loads == [HAND_LOAD, None, HAND_LOAD, None, HAND_LOAD, HAND_LOAD, None, HAND_LOAD]


@pytest.mark.parametrize(
    ("options", "resolutions", "load"),
    [
        ("", {}, None),
        ("", {0x3A: 5}, 2 ** (2 / 3)),  # 510 units are 102 g, 1 N: twice a light press
        ("?light_pressure=510", {}, 1.0),
        ("?light_pressure=255&grab=yes", {0x3A: 5}, 2 ** (2 / 3)),
        ("?light_pressure=0", {0x3A: 5}, None),
        ("?light_pressure=0", {0x3A: 5, 0x35: 10}, 4.0),  # 188 units are 18.8 mm
        ("?light_major=94", {}, 4.0),
        ("", {0x35: 10, 0x30: 20}, 1.0),
        ("", {0x35: 7, 0x3A: 5}, HAND_LOAD),  # 27 mm, whatever its force
    ],
)
def test_evdev_source_reports_loads(
    options: str, resolutions: dict[int, int], load: float | None
) -> None:
    """By force where the pressure has a unit or a value of its own, else by size."""
    panel = PipePanel()
    panel.resolutions = resolutions
    landed = raw("id 7 x 0 y 0 pressure 510 major 188")
    (touch,) = delivered(panel, landed, 0.01, options=options)[-1].touches
    assert touch.load == (None if load is None else pytest.approx(load, rel=2e-3))


GONE = OSError(errno.ENODEV, "gone")


@pytest.mark.parametrize(
    ("at_first", "happens", "words"),
    [
        (None, (0.01, GONE, b"x", 0.05), "lost.*plug it in"),  # one that goes becomes readable
        (None, (0.01, GONE, 0.05), "lost.*plug it in"),
        (OSError(errno.EINVAL, "no slots"), (), "type A"),
    ],
    ids=["noticed by reading", "noticed by polling", "at once"],
)
def test_evdev_source_ends_without_a_panel(
    at_first: OSError | None, happens: tuple[Happens, ...], words: str
) -> None:
    """Within 60 ms of being unplugged, and at once for a panel without slots: EINVAL."""
    panel = PipePanel()
    panel.state = {0: SlotState(7, 0, 0), 1: EMPTY}
    panel.error = at_first
    with pytest.raises(InputError, match=words):
        delivered(panel, *happens)


def test_evdev_source_has_the_times_of_the_kernel() -> None:
    """When an event happened, not when it was read; now, if it is of another clock."""
    happened = [
        raw(words, at=START + time)
        for time in (4.98, 6.0, 3.0)
        for words in ("id 7 x 0 y 0", "id -1")
    ]
    seen = delivered(PipePanel(), 5.0, *happened, 0.01)
    assert [frame.time for frame in seen] == [0.0, 4.98, 4.98, 5.0, 5.0, 5.0, 5.0]


def test_ioctl_request_numbers() -> None:
    """The numbers that the kernel's header gives on x86-64 and Arm, as strace shows them."""
    assert eviocgabs(0x35) == 0x80184575  # EVIOCGABS(ABS_MT_POSITION_X)
    assert eviocgmtslots(44) == 0x802C450A  # EVIOCGMTSLOTS(44)
    assert GRAB == 0x40044590  # EVIOCGRAB
    assert CLOCK == 0x400445A0  # EVIOCSCLOCKID
    assert PRESSED_KEYS == 0x80604518  # EVIOCGKEY(96)


def test_parse_events_skips_incomplete_events() -> None:
    """Each complete event has its time, type, code and value."""
    assert list(parse_events(raw("x -5", at=3.5) + b"\0" * 10)) == [
        (3.5, 3, 0x35, -5),
        (3.5, 0, 0, 0),
    ]


def kernel(
    monkeypatch: pytest.MonkeyPatch,
    *,
    width: int,
    slots: int = 10,
    missing: tuple[int, ...] = (),
    grab: OSError | None = None,
) -> None:
    """Let the kernel report a panel with a width; missing: axes that it does not have."""

    def ioctl(descriptor: int, request: int, argument: bytes | int) -> bytes:
        if request == GRAB:
            if grab is not None:
                raise grab
            return b""
        if request == CLOCK:
            raise OSError(errno.EINVAL, "no such clock")
        if request == PRESSED_KEYS:
            return bytes(41) + b"\4" + bytes(54)  # bit 0x14a
        if isinstance(argument, bytes) and request == eviocgmtslots(len(argument)):
            (axis,) = struct.unpack_from("i", argument)
            return struct.pack(f"{1 + slots}i", axis, *(axis + slot for slot in range(slots)))
        highs = {0x2F: slots - 1, 0x3A: 255, 0x30: 0} | dict.fromkeys(missing, 0)
        axis = request - eviocgabs(0)
        resolution = {0x35: 12, 0x3A: 3}.get(axis, 0)
        return struct.pack("6i", axis, 0, highs.get(axis, width), 0, 0, resolution)

    monkeypatch.setattr("controller.sources.input_device.fcntl.ioctl", ioctl)


BUSY = OSError(errno.EBUSY, "Device or resource busy")


@pytest.mark.parametrize(
    ("path", "reported", "words"),
    [
        ("/dev/null", None, "evtest"),
        ("/dev/input/event987", None, "by-id"),
        ("/dev/null", {"width": 1000, "grab": BUSY}, "`sudo fuser -v /dev/null`"),
        ("/dev/null", {"width": -1}, "0x35.*0 and -1"),
        ("/dev/null", {"width": 0}, "0x0.*0 and 0.*single-touch"),
    ],
)
def test_input_device_refuses_what_is_no_usable_panel(
    monkeypatch: pytest.MonkeyPatch, path: str, reported: dict[str, Any] | None, words: str
) -> None:
    """Another file, a grabbed panel and an axis without width are refused, and closed."""
    if reported is not None:
        kernel(monkeypatch, **reported)
    before = sorted(Path("/proc/self/fd").iterdir())
    with pytest.raises(InputError, match=words):
        InputDevice(path, grab=True)
    assert sorted(Path("/proc/self/fd").iterdir()) == before


@pytest.mark.parametrize("slots", [10, 1])
def test_input_device_opens_a_panel(monkeypatch: pytest.MonkeyPatch, slots: int) -> None:
    """It has the ranges of its axes, and the kernel's values of all slots, of an only one, too."""
    kernel(monkeypatch, width=1000, slots=slots)
    with contextlib.closing(InputDevice("/dev/null")) as device:
        assert device.ranges == {0x35: (0, 1000), 0x36: (0, 1000)}
        assert device.resolutions == {0x35: 12, 0x36: 0, 0x3A: 3, 0x30: 0}
        axes = (0x39, 0x35, 0x36, 0x37, 0x3B, 0x3A, 0x30)
        expected = {n: SlotState(*(axis + n for axis in axes)) for n in range(slots)}
        assert device.slots() == expected


def test_input_device_reads_a_panel_for_a_single_finger(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without multi-touch axes: ABS_X, ABS_Y, ABS_PRESSURE and BTN_TOUCH, as those of a slot."""
    kernel(monkeypatch, width=1000, missing=(0x35, 0x36, 0x3A, 0x2F))
    with contextlib.closing(InputDevice("/dev/null")) as device:
        assert device.ranges == {0x35: (0, 1000), 0x36: (0, 1000)}
        assert device.slots() == {0: SlotState(0, x=0x0, y=0x1, pressure=0x18)}
    events = [(3, 0, 250), (3, 1, 100), (3, 0x18, 9), (1, 0x14A, 1), (1, 0x14A, 0), (0, 0, 0)]
    assert [as_slot_event((2.5, *event)) for event in events] == [
        *((2.5, 3, 0x35, 250), (2.5, 3, 0x36, 100), (2.5, 3, 0x3A, 9)),
        *((2.5, 3, 0x39, 0), (2.5, 3, 0x39, -1), (2.5, 0, 0, 0)),
    ]


Shown: TypeAlias = list[tuple[float, dict[int, tuple[float, float]]]]

CODES = KINDS | {"dropped": (0, 3)}
RANGES = {0x35: (0, 1000), 0x36: (-100, 100), 0x3A: (0, 255), 0x30: (0, 255)}


def shown(reports: Iterable[tuple[float, str]]) -> Shown:
    """States of a panel by reports such as `slot 0 id 7 x 100 y 50`, at times; touches by id."""
    reader, found = SlotReader(RANGES), list[tuple[float, dict[int, tuple[float, float]]]]()
    for time, words in reports:
        pairs = words.split()
        for code, value in zip(pairs[::2], pairs[1::2], strict=True):
            assert reader.feed(*CODES[code], int(value)) is None
        report = reader.feed(0, 0, 0)
        found += [(time, {one.id: (one.x, one.y) for one in each}) for each in report.states]
    return found


SEQUENCES: dict[str, tuple[list[tuple[float, str]], Shown]] = {
    "two fingers, unchanged values omitted": (
        [
            (0.0, "id 7 x 100 y 0"),
            (0.25, "slot 1 id 8 x 900 y 50"),
            (0.5, "x 800 slot 0 y -50"),
            (0.75, "id -1"),
            (1.0, "slot 1 id -1"),
        ],
        [
            (0.0, {7: (0.1, 0.5)}),
            (0.25, {7: (0.1, 0.5), 8: (0.9, 0.75)}),
            (0.5, {7: (0.1, 0.25), 8: (0.8, 0.75)}),
            (0.75, {8: (0.8, 0.75)}),
            (1.0, {}),
        ],
    ),
    "a new contact keeps the coordinates of its slot": (
        [(0, "id 1 x 100 y 0"), (1, "id -1"), (2, "id 2 y 50")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {}), (2.0, {2: (0.1, 0.75)})],
    ),
    "a position after the lift": (
        [(0, "id 1 x 100 y 0"), (1, "id -1"), (2, "x 200")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {}), (2.0, {})],
    ),
    "taps within one report": (
        [(0, "id 1 x 100 y 0 id -1"), (1, "id 2 x 300 y 0 id -1 id 3 x 400")],
        [
            (0.0, {1: (0.1, 0.5)}),
            (0.0, {}),
            (1.0, {2: (0.3, 0.5)}),
            (1.0, {}),
            (1.0, {3: (0.4, 0.5)}),
        ],
    ),
    "a lift within one report, the same id again": (
        [(0, "id 1 x 100 y 0"), (1, "id -1 id 1")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {}), (1.0, {1: (0.1, 0.5)})],
    ),
    "a palm, a finger that becomes one, a hovering finger that lands": (
        [
            (0, "id 1 tool 2 x 100 y 0"),
            (1, "tool 0"),
            (2, "tool 2 slot 1 id 2 distance 5 x 200 y 0"),
            (3, "distance 0"),
        ],
        [
            *((time, {1: (0.1, 0.5)}) for time in (0.0, 1.0, 2.0)),
            (3.0, {1: (0.1, 0.5), 2: (0.2, 0.5)}),
        ],
    ),
    "two slots with one tracking id, and a negative slot": (
        [
            (0, "id 1 x 100 y 0 slot 1 id 1 x 300 y 0"),
            (1, "slot -1 id 4 x 500 slot 0 x 200"),
            (2, "slot 0 id -1"),
        ],
        [
            (0.0, {1: (0.1, 0.5), -2: (0.3, 0.5)}),
            (1.0, {1: (0.2, 0.5), -2: (0.3, 0.5)}),
            (2.0, {1: (0.3, 0.5)}),
        ],
    ),
    "another id without -1 before it": (
        [(0, "id 1 x 100 y 0"), (1, "id 2 x 200")],
        [(0.0, {1: (0.1, 0.5)}), (1.0, {2: (0.2, 0.5)})],
    ),
}


@pytest.mark.parametrize("name", SEQUENCES)
def test_states_follow_slots(name: str) -> None:
    """States are those worked out by hand."""
    reports, expected = SEQUENCES[name]
    assert shown(reports) == expected


@given(
    st.lists(
        st.lists(
            st.one_of(
                st.tuples(st.just("slot"), st.integers(0, 2)),
                st.tuples(st.just("id"), st.integers(-1, 3)),
                st.tuples(st.sampled_from(["x", "y"]), st.integers(0, 100)),
                st.tuples(st.just("dropped"), st.just(0)),
            ),
            max_size=6,
        ),
        min_size=1,
        max_size=8,
    )
)
def test_at_most_as_many_touches_as_slots(reports: list[list[tuple[str, int]]]) -> None:
    """Whatever a panel sends."""
    words = [" ".join(f"{code} {value}" for code, value in each) for each in reports]
    slots = {value for each in reports for code, value in each if code == "slot"} | {0}
    assert all(len(touches) <= len(slots) for _, touches in shown(enumerate(words)))


def test_events_of_type_a_are_refused() -> None:
    """SYN_MT_REPORT, with a reason that names the type."""
    with pytest.raises(InputError, match="type A"):
        SlotReader(RANGES).feed(0, 2, 0)
