"""Values at the sets of points that were used last, shared by threads."""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from model.arrays import FloatArray

_Value = TypeVar("_Value")


@dataclass(eq=False)
class PointCache(Generic[_Value]):
    """Values of up to capacity sets of points (n, 2) or footprints (n, 3).

    Threads that need the same points at the same time may all compute the value.
    """

    capacity: int
    _values: dict[tuple[tuple[int, ...], bytes], _Value] = field(default_factory=dict)

    def get(self, points: FloatArray) -> _Value | None:
        """Return the value at points, None if it is not cached."""
        return self._values.get((points.shape, points.tobytes()))

    def put(self, points: FloatArray, value: _Value) -> None:
        """Cache the value at points, and drop the oldest values beyond the capacity."""
        self._values[points.shape, points.tobytes()] = value
        for oldest in list(self._values)[: -self.capacity]:
            self._values.pop(oldest, None)
