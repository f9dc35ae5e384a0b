"""Multi-touch protocol type B: the contacts in the slots of a Linux touch panel.

A panel for a single finger is one with a single slot, see `as_slot_event`. Events are described in
the Linux kernel's Documentation/input/multi-touch-protocol.rst; the numbers are those of its
input-event-codes.h.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

from controller.sources.loads import LIGHT_FORCE, LIGHT_MAJOR, LightPress
from controller.sources.touch import Touch
from model.errors import InputError

TYPE_A = (
    "multi-touch protocol must be type B (slots), got type A, which does not say which contact is "
    "which; use another panel or driver, or a program that sends its touches as TUIO"
)
"""Why a panel is refused."""

EV_SYN, EV_KEY, EV_ABS = 0x00, 0x01, 0x03
SYN_REPORT, SYN_MT_REPORT, SYN_DROPPED = 0, 2, 3
ABS_X, ABS_Y, ABS_PRESSURE, BTN_TOUCH = 0x00, 0x01, 0x18, 0x14A
ABS_MT_SLOT, ABS_MT_POSITION_X, ABS_MT_POSITION_Y, ABS_MT_TRACKING_ID = 0x2F, 0x35, 0x36, 0x39
ABS_MT_TOUCH_MAJOR, ABS_MT_TOOL_TYPE, ABS_MT_PRESSURE, ABS_MT_DISTANCE = 0x30, 0x37, 0x3A, 0x3B
MT_TOOL_FINGER = 0  # others are a pen, a palm, a dial

Range: TypeAlias = tuple[int, int]  # lowest and highest value of an axis
InputEvent: TypeAlias = tuple[float, int, int, int]
"""An event of a panel: the kernel's time [s], type (EV_...), code and value."""

SINGLE_TOUCH_AXES = {
    ABS_MT_POSITION_X: ABS_X,
    ABS_MT_POSITION_Y: ABS_Y,
    ABS_MT_PRESSURE: ABS_PRESSURE,
}
"""Axes of a slot, and those in their place of a panel for a single finger."""

_OF_ONE_FINGER = {(EV_ABS, single): (EV_ABS, axis) for axis, single in SINGLE_TOUCH_AXES.items()}
_OF_ONE_FINGER[EV_KEY, BTN_TOUCH] = (EV_ABS, ABS_MT_TRACKING_ID)

_GRAVITY = 9.81  # m/s²


def as_slot_event(event: InputEvent) -> InputEvent:
    """Return an event of a panel for a single finger as that of the only slot of another."""
    time, kind, code, value = event
    id_or_value = value - 1 if kind == EV_KEY else value  # pressed is 1, released 0
    return (time, *_OF_ONE_FINGER.get((kind, code), (kind, code)), id_or_value)


@dataclass(frozen=True)
class PanelReport:
    """Events of a panel up to a SYN_REPORT.

    states: all its touches, for each state within the report, so that a contact is seen that comes
    and goes within it or is replaced in its slot. is_partial: events were lost before it, so that
    all contacts are unknown.
    """

    states: tuple[tuple[Touch, ...], ...]
    is_partial: bool = False


@dataclass
class SlotState:
    """A slot as the kernel has it: values of its axes.

    tracking_id: of the contact, negative without one; x, y: None until reported; tool: palms and
    pens are no fingers; distance: above 0 while hovering. Values of axes that the panel does not
    have are 0.
    """

    tracking_id: int = -1
    x: int | None = None
    y: int | None = None
    tool: int = MT_TOOL_FINGER
    distance: int = 0
    pressure: int = 0
    touch_major: int = 0


SLOT_AXES = {
    ABS_MT_TRACKING_ID: "tracking_id",
    ABS_MT_POSITION_X: "x",
    ABS_MT_POSITION_Y: "y",
    ABS_MT_TOOL_TYPE: "tool",
    ABS_MT_DISTANCE: "distance",
    ABS_MT_PRESSURE: "pressure",
    ABS_MT_TOUCH_MAJOR: "touch_major",
}
"""Axes of a slot and their fields in `SlotState`, in its order."""


class SlotReader:
    """Decoder of events into reports, without I/O.

    A contact appears once both its coordinates are known. A slot keeps the coordinates of its last
    contact, since the kernel omits values that did not change. Palms, pens and what hovers are no
    touches: a finger that becomes a palm is lifted. ranges: of the axes ABS_MT_POSITION_X and _Y.
    light_press: values of force and size under a finger that presses lightly.
    """

    def __init__(
        self,
        ranges: Mapping[int, Range],
        *,
        light_press: LightPress = LightPress(),  # noqa: B008  frozen
    ) -> None:
        self._ranges = ranges
        self._light_press = light_press
        self._slots: dict[int, SlotState] = {}
        self._current = 0
        self._pending: list[tuple[Touch, ...]] = []  # intermediate states of this report
        self._changed: set[int] = set()  # slots whose contact has changed within this report
        self._dropped = False

    @property
    def touches(self) -> tuple[Touch, ...]:
        """All touches, by slot; of two with one tracking id the second has an id of its slot."""
        touches: dict[int, Touch] = {}
        for number, slot in sorted(self._slots.items()):
            if (touch := self._touch(slot)) is not None:
                id = touch.id if touch.id not in touches else -1 - number
                touches[id] = touch if id == touch.id else replace(touch, id=id)
        return tuple(touches.values())

    def feed(self, kind: int, code: int, value: int) -> PanelReport | None:
        """Process one event (EV_..., code and value); return the report that it completes, or None.

        Slots that are negative are ignored. Raises InputError for type A.
        """
        if kind == EV_ABS:
            self._feed_axis(code, value)
        elif kind == EV_SYN and code == SYN_MT_REPORT:
            raise InputError(TYPE_A)
        elif kind == EV_SYN and code == SYN_DROPPED:
            self._dropped = True
        elif kind == EV_SYN and code == SYN_REPORT:
            return self._report()
        return None

    def resynchronise(self, slots: Mapping[int, SlotState], *, current: int) -> None:
        """Replace all state by the kernel's, with the slot of the next event."""
        self._current = current
        self._slots = {number: replace(state) for number, state in slots.items()}

    def _report(self) -> PanelReport:
        """Complete the current report."""
        if self._dropped:  # the events since then are incomplete
            self._slots.clear()
        report = PanelReport((*self._pending, self.touches), is_partial=self._dropped)
        self._pending, self._changed, self._dropped = [], set(), False
        return report

    def _feed_axis(self, code: int, value: int) -> None:
        """Process one EV_ABS event."""
        if code == ABS_MT_SLOT:
            self._current = value
        elif code in SLOT_AXES and self._current >= 0:
            if code == ABS_MT_TRACKING_ID:
                if self._current in self._changed and not self._dropped:
                    self._pending.append(self.touches)
                self._changed.add(self._current)
            setattr(self._slots.setdefault(self._current, SlotState()), SLOT_AXES[code], value)

    def _touch(self, slot: SlotState) -> Touch | None:
        """Return the touch in a slot, None unless a finger with known coordinates is there."""
        if slot.tracking_id < 0 or slot.x is None or slot.y is None:
            return None
        if slot.tool != MT_TOOL_FINGER or slot.distance > 0:
            return None
        return Touch(
            slot.tracking_id,
            self._share(ABS_MT_POSITION_X, slot.x),
            self._share(ABS_MT_POSITION_Y, slot.y),
            self._light_press.load(pressure=slot.pressure, touch_major=slot.touch_major),
        )

    def _share(self, code: int, value: int) -> float:
        """Return a value relative to the range of its axis, 0..1."""
        low, high = self._ranges[code]
        return (value - low) / (high - low)


def light_press(resolutions: Mapping[int, int], given: Mapping[int, float]) -> LightPress:
    """Return the values of a panel's axes under a finger that presses lightly.

    resolutions: by axis, 0 or left out where the panel states none: units per millimetre, of a
    pressure units per gram, without which its unit is arbitrary (the kernel's
    input-event-codes.rst). A contact without its own is in the unit of positions. given: such
    values by axis, 0 for one that is not to be used.
    """
    pressure = resolutions.get(ABS_MT_PRESSURE, 0) * 1000 * LIGHT_FORCE / _GRAVITY
    per_mm = resolutions.get(ABS_MT_TOUCH_MAJOR, 0) or resolutions.get(ABS_MT_POSITION_X, 0)
    return LightPress(
        pressure=given.get(ABS_MT_PRESSURE, pressure) or None,
        touch_major=given.get(ABS_MT_TOUCH_MAJOR, per_mm * LIGHT_MAJOR) or None,
    )
