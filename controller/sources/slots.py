"""Multi-touch protocol type B: which fingers are in which slots of a Linux touch panel.

What the events mean is in the Linux kernel's Documentation/input/multi-touch-protocol.rst; the
numbers are those of its input-event-codes.h.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

from controller.sources.touch import Touch

EV_SYN, EV_ABS = 0x00, 0x03
SYN_REPORT, SYN_MT_REPORT, SYN_DROPPED = 0, 2, 3
ABS_MT_SLOT, ABS_MT_POSITION_X, ABS_MT_POSITION_Y, ABS_MT_TRACKING_ID = 0x2F, 0x35, 0x36, 0x39

Range: TypeAlias = tuple[int, int]  # lowest and highest value of an axis


class EventError(ValueError):
    """An event that no panel of type B sends."""


@dataclass(frozen=True)
class Report:
    """What a panel said until its SYN_REPORT.

    states: all its touches, once for each state within the report; a contact that comes and goes
    within it, or gives way to another in its slot, is seen so. is_partial: events were lost before
    it, so that no contact is known any more.
    """

    states: tuple[tuple[Touch, ...], ...]
    is_partial: bool = False


@dataclass(frozen=True)
class SlotState:
    """What the kernel itself says of a slot: the tracking id, below zero without a contact."""

    tracking_id: int
    x: int
    y: int


@dataclass
class _Slot:
    """What the events have said of one slot; None where they have not.

    contact: the touch's id, None without a contact. certain: whether a tracking id said so; a
    slot that moves without one has had its contact since before the first event.
    """

    contact: int | None = None
    certain: bool = False
    x: float | None = None
    y: float | None = None


class SlotReader:
    """Events in, reports out; no device, no clock.

    A contact appears when both its coordinates are known. What a slot still knows of its last
    contact holds for the next one, since the kernel leaves out values that did not change.
    Contacts that were down before the first event have negative ids.
    """

    def __init__(self, x_range: Range, y_range: Range, *, first_slot: int = 0) -> None:
        self._x_range = x_range
        self._y_range = y_range
        self._slots: dict[int, _Slot] = {}
        self._current = first_slot
        self._nameless = 0
        self._pending: list[tuple[Touch, ...]] = []  # states of this report that would go unseen
        self._retold: set[int] = set()  # slots whose contact has changed within this report
        self._dropped = False

    @property
    def touches(self) -> tuple[Touch, ...]:
        """All contacts whose place is known, by slot."""
        return tuple(
            Touch(slot.contact, slot.x, slot.y)
            for _, slot in sorted(self._slots.items())
            if slot.contact is not None and slot.x is not None and slot.y is not None
        )

    def take(self, kind: int, code: int, value: int) -> Report | None:
        """Follow one event (EV_..., its code and value); the report that it ends, or None.

        Raises EventError on events of type A and on a slot below zero.
        """
        if kind == EV_ABS:
            self._take_axis(code, value)
        elif kind == EV_SYN and code == SYN_MT_REPORT:
            raise EventError(
                "multi-touch protocol type A (SYN_MT_REPORT); "
                "only panels that report slots (type B) can be read"
            )
        elif kind == EV_SYN and code == SYN_DROPPED:
            self._dropped = True
        elif kind == EV_SYN and code == SYN_REPORT:
            return self._report()
        return None

    def adopt(self, slots: Mapping[int, SlotState], *, current: int) -> None:
        """Begin anew from what the kernel says of every slot, and which one comes next."""
        self._current = current
        self._slots = {
            number: _Slot(
                contact=state.tracking_id if state.tracking_id >= 0 else None,
                certain=True,
                x=_share(state.x, self._x_range),
                y=_share(state.y, self._y_range),
            )
            for number, state in slots.items()
        }

    def _report(self) -> Report:
        """The report that ends now."""
        if self._dropped:  # what came since is a part of a report
            self._slots.clear()
        report = Report((*self._pending, self.touches), is_partial=self._dropped)
        self._pending, self._retold, self._dropped = [], set(), False
        return report

    def _take_axis(self, code: int, value: int) -> None:
        """Follow one EV_ABS event."""
        slot = self._slots.setdefault(self._current, _Slot())
        if code == ABS_MT_SLOT:
            if value < 0:
                raise EventError(f"slot {value} is below zero")
            self._current = value
        elif code == ABS_MT_TRACKING_ID:
            if self._current in self._retold and not self._dropped:
                self._pending.append(self.touches)
            self._retold.add(self._current)
            slot.contact = value if value >= 0 else None
            slot.certain = True
        elif code in (ABS_MT_POSITION_X, ABS_MT_POSITION_Y):
            if slot.contact is None and not slot.certain:
                self._nameless += 1
                slot.contact = -self._nameless  # tracking ids are never negative
            if code == ABS_MT_POSITION_X:
                slot.x = _share(value, self._x_range)
            else:
                slot.y = _share(value, self._y_range)


def _share(value: int, limits: Range) -> float:
    """Where a value lies in its axis' range, 0..1 within it."""
    low, high = limits
    return (value - low) / (high - low)
