"""Touches from the events of a touch panel, without I/O.

Panels use multi-touch protocol type B, with contacts in slots. Events are described in the kernel's
Documentation/input/multi-touch-protocol.rst, with the numbers of its input-event-codes.h.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

from controller.sources.contact_load import LIGHT_FORCE, LIGHT_MAJOR, LightPress
from controller.sources.touch import Touch
from model.errors import InputError
from registry.limits import HAND_LOAD

TYPE_A = (
    "multi-touch protocol must be type B (slots), got type A, which does not say which contact is "
    "which; use another panel or driver, or a program that sends its touches as TUIO"
)
"""Refusal of a panel."""

EV_SYN, EV_KEY, EV_ABS = 0x00, 0x01, 0x03
SYN_REPORT, SYN_MT_REPORT, SYN_DROPPED = 0, 2, 3
ABS_X, ABS_Y, ABS_PRESSURE, BTN_TOUCH = 0x00, 0x01, 0x18, 0x14A
ABS_MT_SLOT, ABS_MT_POSITION_X, ABS_MT_POSITION_Y, ABS_MT_TRACKING_ID = 0x2F, 0x35, 0x36, 0x39
ABS_MT_TOUCH_MAJOR, ABS_MT_TOOL_TYPE, ABS_MT_PRESSURE, ABS_MT_DISTANCE = 0x30, 0x37, 0x3A, 0x3B
MT_TOOL_FINGER, MT_TOOL_PALM = 0, 2  # others are a pen, a dial

Range: TypeAlias = tuple[int, int]  # lowest and highest value of an axis

_GRAVITY = 9.81  # m/s²


@dataclass(frozen=True)
class PanelReport:
    """Events of a panel up to a SYN_REPORT."""

    states: tuple[tuple[Touch, ...], ...]
    """All touches in each state within the report: a contact may come and go within it, or be
    replaced in its slot."""
    is_partial: bool = False
    """Whether events were lost before it, so that all contacts are unknown."""


@dataclass
class SlotState:
    """The values of a slot's axes in the kernel; 0 for axes that the panel does not have."""

    tracking_id: int = -1
    """Of the contact; negative without one."""
    x: int | None = None
    """None until reported, as y."""
    y: int | None = None
    tool: int = MT_TOOL_FINGER
    """Palms are hands, pens are no touches."""
    distance: int = 0
    """Above 0 while hovering."""
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
    """Decodes events into reports, without I/O.

    A contact appears once both its coordinates are known. A slot keeps the coordinates of its last
    contact, since the kernel omits values that did not change. Pens and hovering fingers are no
    touches; a palm is a hand that rests, with its load. ranges: of the axes ABS_MT_POSITION_X and
    _Y; light_press: values of force and size under a finger that presses lightly.
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
        self._has_lost_events = False

    @property
    def touches(self) -> tuple[Touch, ...]:
        """All touches, by slot; the second of two with one tracking id gets an id of its slot."""
        touches: dict[int, Touch] = {}
        for number, slot in sorted(self._slots.items()):
            touch = self._touch(slot)
            if touch is None:
                continue
            if touch.id in touches:
                touch = replace(touch, id=-1 - number)
            touches[touch.id] = touch
        return tuple(touches.values())

    def feed(self, kind: int, code: int, value: int) -> PanelReport | None:
        """Process one event (EV_..., code and value); return the report that it completes, or None.

        Slots that are negative are ignored. Raises InputError for type A.
        """
        if kind == EV_ABS and code == ABS_MT_SLOT:
            self._current = value
        elif kind == EV_ABS and code in SLOT_AXES and self._current >= 0:
            self._set_axis(code, value)
        elif kind == EV_SYN and code == SYN_MT_REPORT:
            raise InputError(TYPE_A)
        elif kind == EV_SYN and code == SYN_DROPPED:
            self._has_lost_events = True
        elif kind == EV_SYN and code == SYN_REPORT:
            return self._finish_report()
        return None

    def _set_axis(self, code: int, value: int) -> None:
        """Set an axis of the current slot; a second contact in a slot begins another state."""
        if code == ABS_MT_TRACKING_ID:
            if self._current in self._changed and not self._has_lost_events:
                self._pending.append(self.touches)
            self._changed.add(self._current)
        slot = self._slots.setdefault(self._current, SlotState())
        setattr(slot, SLOT_AXES[code], value)

    def _finish_report(self) -> PanelReport:
        """Return the report that ends, and prepare the next one."""
        if self._has_lost_events:
            self._slots.clear()
        report = PanelReport((*self._pending, self.touches), is_partial=self._has_lost_events)
        self._pending = []
        self._changed = set()
        self._has_lost_events = False
        return report

    def resynchronise(self, slots: Mapping[int, SlotState], *, current: int) -> None:
        """Replace all state by the kernel's; current: slot of the next event."""
        self._current = current
        self._slots = {number: replace(state) for number, state in slots.items()}

    def _touch(self, slot: SlotState) -> Touch | None:
        """Return the touch in a slot, None unless a finger with known coordinates is there."""
        if slot.tracking_id < 0 or slot.x is None or slot.y is None:
            return None
        if slot.tool not in (MT_TOOL_FINGER, MT_TOOL_PALM) or slot.distance > 0:
            return None
        load: float | None = HAND_LOAD
        if slot.tool == MT_TOOL_FINGER:
            load = self._light_press.load(pressure=slot.pressure, touch_major=slot.touch_major)
        x = self._share(ABS_MT_POSITION_X, slot.x)
        y = self._share(ABS_MT_POSITION_Y, slot.y)
        return Touch(slot.tracking_id, x, y, load)

    def _share(self, code: int, value: int) -> float:
        """Return a value relative to the range of its axis, 0..1."""
        low, high = self._ranges[code]
        return (value - low) / (high - low)


def light_press(resolutions: Mapping[int, int], stated: Mapping[int, float]) -> LightPress:
    """Return the values of a panel's axes under a finger that presses lightly.

    resolutions: by axis, in units per millimeter, or units per gram for a pressure; 0 or missing if
    the panel does not state it. A pressure without resolution has an arbitrary unit (the kernel's
    input-event-codes.rst); a contact size without resolution has the unit of positions. stated:
    values from the URL by axis, which take precedence; 0 disables an axis.
    """
    pressure = resolutions.get(ABS_MT_PRESSURE, 0) * 1000 * LIGHT_FORCE / _GRAVITY
    per_mm = resolutions.get(ABS_MT_TOUCH_MAJOR, 0) or resolutions.get(ABS_MT_POSITION_X, 0)
    return LightPress(
        pressure=stated.get(ABS_MT_PRESSURE, pressure) or None,
        touch_major=stated.get(ABS_MT_TOUCH_MAJOR, per_mm * LIGHT_MAJOR) or None,
    )
