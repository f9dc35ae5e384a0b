"""Touch panels that are read from the kernel's input devices, with a pipe in place of the device.

Events are worked out by hand from the kernel's multi-touch protocol, type B.
"""

import asyncio
import contextlib
import errno
import os
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

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
from kit.clock import in_virtual_time
from model.errors import InputError
from registry import threads
from registry.limits import HAND_LOAD
from registry.virtual_time import START

EMPTY = SlotState(-1, 0, 0)
CODES = {
    "slot": (3, 0x2F),
    "id": (3, 0x39),
    "x": (3, 0x35),
    "y": (3, 0x36),
    "tool": (3, 0x37),
    "distance": (3, 0x3B),
    "pressure": (3, 0x3A),
    "major": (3, 0x30),
    "dropped": (0, 3),
}
"""Type and code of events."""
END_OF_REPORT = (0, 0, 0)

Positions = dict[int, tuple[float, float]]


def events_of(words: str) -> list[tuple[int, int, int]]:
    """Events such as "slot 0 id 7 x 100 y 50"."""
    pairs = words.split()
    names, values = pairs[::2], pairs[1::2]
    return [(*CODES[name], int(value)) for name, value in zip(names, values, strict=True)]


def report_of(words: str, *, at: float = 0.0) -> bytes:
    """A report as struct input_event has it on x86-64 and Arm; at: its time [s]."""
    seconds = int(at)
    microseconds = round(at % 1 * 1e6)
    return b"".join(
        struct.pack("@qqHHi", seconds, microseconds, *event)
        for event in [*events_of(words), END_OF_REPORT]
    )


def positions_of(frame: TouchFrame) -> Positions:
    """The position of each touch."""
    return {touch.id: (touch.x, touch.y) for touch in frame.touches}


class PipePanel:
    """A panel of 1000 by 500 with two slots, whose events come through a pipe."""

    def __init__(self) -> None:
        self.ranges = {0x35: (0, 1000), 0x36: (0, 500), 0x3A: (0, 255)}
        self.resolutions: dict[int, int] = {}
        self.current_slot = 0
        self.state = {0: EMPTY, 1: EMPTY}
        """The kernel's state of each slot."""
        self.error: OSError | None = None
        """What each access raises."""
        self.frames: list[TouchFrame] = []
        """The frames of a source that reads this panel, with times since its start [s]."""
        self._out, self.into = os.pipe()
        os.set_blocking(self._out, False)

    def fileno(self) -> int:
        """Return the pipe's read end."""
        return self._out

    def slots(self) -> dict[int, SlotState]:
        """Return the kernel's state."""
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

    async def report(self, words: str, *, pause: float = 0.01) -> None:
        """Send a report, and wait for a time [s]."""
        os.write(self.into, report_of(words))
        await asyncio.sleep(pause)

    def poll_as(self, **slots: SlotState) -> None:
        """Let the kernel's state be this, by `slot0` and `slot1`."""
        self.state = {0: slots.get("slot0", EMPTY), 1: slots.get("slot1", EMPTY)}

    @property
    def positions(self) -> list[Positions]:
        """The positions of touches in each frame."""
        return [positions_of(frame) for frame in self.frames]


@asynccontextmanager
async def source_of(panel: PipePanel, *, options: str = "") -> AsyncIterator[None]:
    """A source that reads a panel; raises what ends it."""
    start = threads.now()

    def deliver(frame: TouchFrame) -> None:
        assert frame.source == "evdev:p"
        panel.frames.append(replace(frame, time=round(frame.time - start, 6)))

    source = EvdevSource(f"evdev:p{options}", open_panel=lambda path, *, grab: panel)
    running = asyncio.create_task(source.run(deliver))
    await asyncio.sleep(0)
    yield
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running


@in_virtual_time
async def test_source_follows_fingers() -> None:
    """Each report is a frame, in shares of the panel's axes, y downwards as the kernel counts.

    Fingers on the panel when it is opened are delivered immediately, with the slot of the next
    event; after SYN_DROPPED the kernel's state counts, as its documentation requires.
    """
    panel = PipePanel()
    panel.poll_as(slot1=SlotState(5, 500, 250))
    panel.current_slot = 1
    async with source_of(panel):
        await panel.report("x 600")
        await panel.report("slot 0 id 7 x 250 y 100")
        await panel.report("slot 1 id -1")
        panel.poll_as(slot1=SlotState(9, 1000, 0))
        await panel.report("slot 0 x 900 dropped 0")
    assert panel.positions == [
        {5: (0.5, 0.5)},
        {5: (0.6, 0.5)},
        {5: (0.6, 0.5), 7: (0.25, 0.2)},
        {7: (0.25, 0.2)},
        {9: (1.0, 0.0)},
    ]


@in_virtual_time
async def test_source_repeats_resting_fingers() -> None:
    """The kernel's state is polled every 50 ms, well within the contact timeout of 150 ms.

    A lift without an event is noticed then.
    """
    panel = PipePanel()
    async with source_of(panel):
        await panel.report("id 7 x 0 y 0", pause=0.0)
        panel.poll_as(slot0=SlotState(7, 0, 0))
        await asyncio.sleep(0.12)
        panel.poll_as()
        await asyncio.sleep(0.2)
    assert [frame.time for frame in panel.frames] == [0.0, 0.0, 0.05, 0.1, 0.15]
    resting = {7: (0.0, 0.0)}
    assert panel.positions == [{}, resting, resting, resting, {}]


@in_virtual_time
async def test_source_reports_palms_as_hands_and_ignores_pens_and_hovering_contacts() -> None:
    """By events and by polling.

    Tools 1 and 2 are a pen and a palm in the kernel's input-event-codes.h; a distance above zero is
    a hovering contact, by its multi-touch-protocol.rst.
    """
    panel = PipePanel()
    panel.poll_as(slot0=SlotState(5, 500, 250, tool=2), slot1=SlotState(6, 500, 250, distance=3))
    async with source_of(panel):
        for words in ("slot 0 tool 0", "tool 1", "slot 1 distance 0", "distance 1", "id -1"):
            await panel.report(words, pause=0.001)
        await panel.report("slot 0 id 7 tool 2 x 250 y 100", pause=0.001)
        await panel.report("id 9 tool 0", pause=0.001)
        panel.poll_as(slot0=SlotState(9, 250, 100, tool=2))
        await asyncio.sleep(0.05)
    loads = [{touch.id: touch.load for touch in frame.touches} for frame in panel.frames]
    assert loads == [
        {5: HAND_LOAD},
        {5: None},
        {},
        {6: None},
        {},
        {},
        {7: HAND_LOAD},
        {9: None},
        {9: HAND_LOAD},
    ]


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
@in_virtual_time
async def test_source_reports_loads(
    options: str, resolutions: dict[int, int], load: float | None
) -> None:
    """By force if the pressure has a unit or a value of its own, otherwise by size."""
    panel = PipePanel()
    panel.resolutions = resolutions
    async with source_of(panel, options=options):
        await panel.report("id 7 x 0 y 0 pressure 510 major 188")
    (touch,) = panel.frames[-1].touches
    assert touch.load == (None if load is None else pytest.approx(load, rel=2e-3))


async def unplug(panel: PipePanel, *, becomes_readable: bool) -> None:
    """Unplug a panel after 10 ms, and wait for 50 ms more."""
    async with source_of(panel):
        await asyncio.sleep(0.01)
        panel.error = OSError(errno.ENODEV, "gone")
        if becomes_readable:
            os.write(panel.into, b"x")
        await asyncio.sleep(0.05)


@pytest.mark.parametrize("becomes_readable", [True, False])
@in_virtual_time
async def test_source_ends_within_60_ms_of_being_unplugged(becomes_readable: bool) -> None:
    """It is noticed by reading, or by polling."""
    panel = PipePanel()
    panel.poll_as(slot0=SlotState(7, 0, 0))
    with pytest.raises(InputError, match=r"lost.*plug it in"):
        await unplug(panel, becomes_readable=becomes_readable)


@in_virtual_time
async def test_source_refuses_a_panel_without_slots() -> None:
    """The kernel answers EINVAL."""
    panel = PipePanel()
    panel.error = OSError(errno.EINVAL, "no slots")
    with pytest.raises(InputError, match="type A"):
        async with source_of(panel):
            await asyncio.sleep(0)


@in_virtual_time
async def test_frames_have_the_times_of_the_kernel() -> None:
    """When an event happened, not when it was read; now, if it is of another clock."""
    panel = PipePanel()
    async with source_of(panel):
        await asyncio.sleep(5.0)
        for time in (4.98, 6.0, 3.0):
            os.write(panel.into, report_of("id 7 x 0 y 0", at=START + time))
            os.write(panel.into, report_of("id -1", at=START + time))
        await asyncio.sleep(0.01)
    times = [frame.time for frame in panel.frames]
    assert times == [0.0, 4.98, 4.98, 5.0, 5.0, 5.0, 5.0]


def test_ioctl_request_numbers() -> None:
    """The numbers that the kernel's header gives on x86-64 and Arm, as strace shows them."""
    assert eviocgabs(0x35) == 0x80184575  # EVIOCGABS(ABS_MT_POSITION_X)
    assert eviocgmtslots(44) == 0x802C450A  # EVIOCGMTSLOTS(44)
    assert GRAB == 0x40044590  # EVIOCGRAB
    assert CLOCK == 0x400445A0  # EVIOCSCLOCKID
    assert PRESSED_KEYS == 0x80604518  # EVIOCGKEY(96)


def test_incomplete_events_are_skipped() -> None:
    """Each complete event has its time, type, code and value."""
    events = list(parse_events(report_of("x -5", at=3.5) + b"\0" * 10))
    assert events == [(3.5, 3, 0x35, -5), (3.5, 0, 0, 0)]


def kernel(
    width: int,
    *,
    slots: int = 10,
    missing_axes: tuple[int, ...] = (),
    grab_error: OSError | None = None,
) -> Callable[..., bytes]:
    """The ioctl of a kernel with a panel of a width."""
    maxima = {0x2F: slots - 1, 0x3A: 255, 0x30: 0} | dict.fromkeys(missing_axes, 0)
    resolutions = {0x35: 12, 0x3A: 3}

    def ioctl(descriptor: int, request: int, argument: bytes | int) -> bytes:
        if request == GRAB and grab_error is not None:
            raise grab_error
        if request == GRAB:
            return b""
        if request == CLOCK:
            raise OSError(errno.EINVAL, "no such clock")
        if request == PRESSED_KEYS:
            return bytes(41) + b"\4" + bytes(54)  # bit 0x14a
        if isinstance(argument, bytes) and request == eviocgmtslots(len(argument)):
            (axis,) = struct.unpack_from("i", argument)
            values = [axis + slot for slot in range(slots)]
            return struct.pack(f"{1 + slots}i", axis, *values)
        axis = request - eviocgabs(0)
        maximum = maxima.get(axis, width)
        return struct.pack("6i", axis, 0, maximum, 0, 0, resolutions.get(axis, 0))

    return ioctl


IOCTL = "controller.sources.input_device.fcntl.ioctl"
BUSY = OSError(errno.EBUSY, "Device or resource busy")


@pytest.mark.parametrize(
    ("path", "ioctl", "words"),
    [
        ("/dev/null", None, "evtest"),
        ("/dev/input/event987", None, "by-id"),
        ("/dev/null", kernel(1000, grab_error=BUSY), "`sudo fuser -v /dev/null`"),
        ("/dev/null", kernel(-1), "0x35.*0 and -1"),
        ("/dev/null", kernel(0), "0x0.*0 and 0.*single-touch"),
    ],
)
def test_input_device_refuses_and_closes_what_is_no_usable_panel(
    monkeypatch: pytest.MonkeyPatch, path: str, ioctl: Any, words: str
) -> None:
    """Another file, a missing one, a grabbed panel, and axes without width."""
    if ioctl is not None:
        monkeypatch.setattr(IOCTL, ioctl)
    descriptors = Path("/proc/self/fd")
    open_before = sorted(descriptors.iterdir())
    with pytest.raises(InputError, match=words):
        InputDevice(path, grab=True)
    assert sorted(descriptors.iterdir()) == open_before


@pytest.mark.parametrize("slots", [10, 1])
def test_input_device_has_the_kernels_values_of_all_slots(
    monkeypatch: pytest.MonkeyPatch, slots: int
) -> None:
    """It also has the ranges and resolutions of its axes."""
    monkeypatch.setattr(IOCTL, kernel(1000, slots=slots))
    with contextlib.closing(InputDevice("/dev/null")) as device:
        assert device.ranges == {0x35: (0, 1000), 0x36: (0, 1000)}
        assert device.resolutions == {0x35: 12, 0x36: 0, 0x3A: 3, 0x30: 0}
        states = device.slots()
    axes = (0x39, 0x35, 0x36, 0x37, 0x3B, 0x3A, 0x30)
    expected = {slot: SlotState(*[axis + slot for axis in axes]) for slot in range(slots)}
    assert states == expected


def test_input_device_reads_a_panel_for_a_single_finger(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without multi-touch axes: ABS_X, ABS_Y, ABS_PRESSURE and BTN_TOUCH are those of a slot."""
    monkeypatch.setattr(IOCTL, kernel(1000, missing_axes=(0x35, 0x36, 0x3A, 0x2F)))
    with contextlib.closing(InputDevice("/dev/null")) as device:
        assert device.ranges == {0x35: (0, 1000), 0x36: (0, 1000)}
        assert device.slots() == {0: SlotState(0, x=0x0, y=0x1, pressure=0x18)}


@pytest.mark.parametrize(
    ("single_touch", "slot_event"),
    [
        ((3, 0, 250), (3, 0x35, 250)),
        ((3, 1, 100), (3, 0x36, 100)),
        ((3, 0x18, 9), (3, 0x3A, 9)),
        ((1, 0x14A, 1), (3, 0x39, 0)),
        ((1, 0x14A, 0), (3, 0x39, -1)),
        (END_OF_REPORT, END_OF_REPORT),
    ],
)
def test_events_of_a_single_finger_are_those_of_a_slot(
    single_touch: tuple[int, int, int], slot_event: tuple[int, int, int]
) -> None:
    """BTN_TOUCH begins and ends a contact."""
    assert as_slot_event((2.5, *single_touch)) == (2.5, *slot_event)


RANGES = {0x35: (0, 1000), 0x36: (-100, 100), 0x3A: (0, 255), 0x30: (0, 255)}


def states_after(*reports: str) -> list[list[Positions]]:
    """The states of a panel after each report; several if a finger taps within one."""
    reader = SlotReader(RANGES)
    states = []
    for words in reports:
        for event in events_of(words):
            assert reader.feed(*event) is None
        report = reader.feed(*END_OF_REPORT)
        assert report is not None
        states.append(
            [{touch.id: (touch.x, touch.y) for touch in state} for state in report.states]
        )
    return states


FIRST = {1: (0.1, 0.5)}
"""A finger after "id 1 x 100 y 0"."""


@pytest.mark.parametrize(
    ("reports", "expected"),
    [
        pytest.param(
            ["id 1 x 100 y 0", "slot 1 id 8 x 900 y 50", "x 800 slot 0 y -50", "id -1"],
            [
                [FIRST],
                [{**FIRST, 8: (0.9, 0.75)}],
                [{1: (0.1, 0.25), 8: (0.8, 0.75)}],
                [{8: (0.8, 0.75)}],
            ],
            id="two fingers, unchanged values omitted",
        ),
        pytest.param(
            ["id 1 x 100 y 0", "id -1", "x 200", "id 2 y 50"],
            [[FIRST], [{}], [{}], [{2: (0.2, 0.75)}]],
            id="a new contact keeps the coordinates of its slot",
        ),
        pytest.param(
            ["id 1 x 100 y 0 id -1", "id 2 x 300 y 0 id -1 id 3 x 400"],
            [[FIRST, {}], [{2: (0.3, 0.5)}, {}, {3: (0.4, 0.5)}]],
            id="taps within one report",
        ),
        pytest.param(
            ["id 1 x 100 y 0", "id -1 id 1"],
            [[FIRST], [{}, FIRST]],
            id="a lift within one report, the same id again",
        ),
        pytest.param(
            ["id 1 tool 2 x 100 y 0", "slot 1 id 2 distance 5 x 200 y 0", "distance 0"],
            [[FIRST], [FIRST], [{**FIRST, 2: (0.2, 0.5)}]],
            id="a palm, and a hovering finger that lands",
        ),
        pytest.param(
            [
                "id 1 x 100 y 0 slot 1 id 1 x 300 y 0",
                "slot -1 id 4 x 500 slot 0 x 200",
                "slot 0 id -1",
            ],
            [
                [{**FIRST, -2: (0.3, 0.5)}],
                [{1: (0.2, 0.5), -2: (0.3, 0.5)}],
                [{1: (0.3, 0.5)}],
            ],
            id="two slots with one tracking id, and a negative slot",
        ),
        pytest.param(
            ["id 1 x 100 y 0", "id 2 x 200"],
            [[FIRST], [{2: (0.2, 0.5)}]],
            id="another id without -1 before it",
        ),
    ],
)
def test_states_follow_slots(reports: list[str], expected: list[list[Positions]]) -> None:
    """States are those worked out by hand."""
    assert states_after(*reports) == expected


EVENTS = st.one_of(
    st.tuples(st.just("slot"), st.integers(0, 2)),
    st.tuples(st.just("id"), st.integers(-1, 3)),
    st.tuples(st.sampled_from(["x", "y"]), st.integers(0, 100)),
    st.tuples(st.just("dropped"), st.just(0)),
)


@given(st.lists(st.lists(EVENTS, max_size=6), min_size=1, max_size=8))
def test_at_most_as_many_touches_as_slots(reports: list[list[tuple[str, int]]]) -> None:
    """Whatever a panel sends."""
    slots = {value for report in reports for name, value in report if name == "slot"} | {0}
    words = [" ".join(f"{name} {value}" for name, value in report) for report in reports]
    for states in states_after(*words):
        for state in states:
            assert len(state) <= len(slots), state


def test_events_of_type_a_are_refused() -> None:
    """SYN_MT_REPORT; the reason names the type."""
    with pytest.raises(InputError, match="type A"):
        SlotReader(RANGES).feed(0, 2, 0)
