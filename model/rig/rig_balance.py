"""Load of each support of a rig's plate, and warnings of tipping."""

from collections import Counter
from collections.abc import Iterator
from typing import Any

from model.arrays import Point
from model.quantities import counted
from model.rig.rig import Rig
from model.structure.attachments import DEFAULT_POINTS
from model.structure.statics import Balance, balance_of

TOUCH_FORCE = 1.0
"""Force [N] of a firm touch, which should not tip a plate (docs/concepts/people.md)."""

_NEAR_EDGE = 0.1
"""Fraction of the supports' extent within which a center of mass is near their edge."""

_LIFTS = -1e-6  # N; lower loads mean that a support is pulled upwards
_EDGES = "edges"  # name of supports along all edges


class RigBalance:
    """Static balance of a rig's plate on its supports."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._balance: Balance = balance_of(rig.plate, rig.eras, rig.masses)
        kinds = _kinds_by_name(rig)
        names = [name for name, count in _support_counts(rig).items() for _ in range(count)]
        self.loads: Counter[str] = Counter()
        """Static load [N] of each support by name; for supports along the edges, the sum."""
        for name, load in zip(names, self._balance.loads.tolist(), strict=True):
            self.loads[name] += load
        self._kinds = {name: kinds[name] for name in self.loads}

    @property
    def tips_over(self) -> bool:
        """Whether the plate tips over under its own weight."""
        return self._balance.inside < 0

    @property
    def phrase(self) -> str:
        """Describe the balance, as the end of a sentence."""
        parts = []
        for kind, count in Counter(self._kinds.values()).items():
            loads = [load for name, load in self.loads.items() if self._kinds[name] == kind]
            newtons = f"{_span(min(loads), max(loads))} N"
            if kind == _EDGES:
                parts.append(f"its edges ({newtons})")
            elif count == 1:
                parts.append(f"1 {kind} ({newtons})")
            else:
                plural = "feet" if kind == "foot" else f"{kind}s"
                parts.append(f"{counted(count, kind, plural=plural)} ({newtons} each)")
        return f"rests on {' and '.join(parts)}"

    def notes(self) -> Iterator[str]:
        """Yield warnings of a plate that tips over, nearly tips over, or lifts off a support."""
        balance = self._balance
        center = f"the center of mass, {_millimeters(balance.center)},"
        where = f"{'eras' if self._rests_on_eras else 'supports'}"
        if self.tips_over:
            yield (
                f"{where}: {center} is {-1e3 * balance.inside:.3g} mm outside {self._names}: the "
                "plate tips over; move them apart, or add supports"
            )
            return
        for name, load in self.loads.items():
            if load < _LIFTS:
                yield (
                    f"{where}.{name}: carries {load:.2g} N, so the plate lifts off it, or pulls at "
                    "it; move it toward the center of mass, at "
                    f"{_millimeters(balance.center)}, or make it softer"
                )
        if balance.inside_share < _NEAR_EDGE:
            yield (
                f"{where}: {center} is only {1e3 * balance.inside:.2g} mm within {self._names}: "
                "the plate nearly tips over; move them apart, or add supports"
            )
        tipping = self._tipping_touch()
        if tipping is not None and tipping[0] < TOUCH_FORCE:
            force, point = tipping
            yield (
                f"{where}: a finger that presses with {force:.2g} N at {_millimeters(point)} tips "
                f"the plate over; a firm touch has {TOUCH_FORCE:g} N: move {self._names} apart, or "
                "add supports"
            )

    def as_json(self) -> dict[str, Any]:
        """Return the JSON object of `era config check --json`."""
        balance = self._balance
        tipping = self._tipping_touch()
        return {
            "weight_n": balance.weight,
            "centre_of_mass_m": [*balance.center],
            "static_loads_n": dict(self.loads),
            "inside_m": balance.inside,
            "tipping_force_n": None if tipping is None else tipping[0],
            "tipping_at_m": None if tipping is None else [*tipping[1]],
        }

    @property
    def _rests_on_eras(self) -> bool:
        return set(self._kinds.values()) == {"ERA"}

    @property
    def _names(self) -> str:
        return f"the supports {', '.join(self.loads)}"

    def _tipping_touch(self) -> tuple[float, Point] | None:
        """Return the least force [N] of a finger that tips the plate, and its position [m].

        None if no force does: supports other than feet are bolted or glued to the plate.
        """
        if self.tips_over or set(self._kinds.values()) != {"foot"}:
            return None
        plate = self._rig.plate
        corners = [(x, y) for x in (0.0, plate.length) for y in (0.0, plate.width)]
        outline = [] if plate.surface is None else plate.surface.outline
        return self._balance.tipping_force([point for ring in outline for point in ring] or corners)


def _support_counts(rig: Rig) -> dict[str, int]:
    """Return the number of springs of each support, by name, in the order of their loads.

    ERAs come first, then the supports of the file, then passive mounts.
    """
    counts = {era.name: 1 for era in rig.eras if era.support.stiffness > 0}
    springs = [load for load in rig.masses if load.stiffness > 0]
    file_springs = len(springs) - len(_mount_names(rig))
    keys: Any = {} if rig.document is None else rig.document.data.get("supports")
    supports: dict[str, Any] = dict(keys or {})
    for name, section in supports.items():
        is_along = "along" in section
        counts[name] = 4 * section.get("points", DEFAULT_POINTS) if is_along else 1
    if sum(counts[name] for name in supports) != file_springs:  # a rig without a file
        for name in supports:
            del counts[name]
        counts |= {f"support {number}": 1 for number in range(1, file_springs + 1)}
    return counts | dict.fromkeys(_mount_names(rig), 1)


def _mount_names(rig: Rig) -> list[str]:
    """Return the names of passive mounts."""
    mounts = rig.masses[len(rig.masses) - len(rig.supports) :]
    return [name for name, mount in zip(rig.supports, mounts, strict=True) if mount.stiffness > 0]


def _kinds_by_name(rig: Rig) -> dict[str, str]:
    """Return the kind of each support by name."""
    kinds = {}
    mounts = {*_mount_names(rig)}
    eras = {era.name for era in rig.eras}
    for name, count in _support_counts(rig).items():
        if name in eras:
            kinds[name] = "ERA"
        elif name in mounts:
            kinds[name] = "mount"
        else:
            kinds[name] = "foot" if count == 1 else _EDGES
    return kinds


def _span(low: float, high: float) -> str:
    """Format the minimum and maximum, or a single value if both read the same."""
    first, last = f"{low:.2g}", f"{high:.2g}"
    return first if first == last else f"{first} to {last}"


def _millimeters(point: Point) -> str:
    return f"({1e3 * point[0]:.0f}, {1e3 * point[1]:.0f}) mm"
