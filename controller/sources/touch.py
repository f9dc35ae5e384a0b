"""What every touch source delivers: all touches that it sees, at one moment."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Touch:
    """One finger as its source sees it.

    id: the source's own, constant from down to up; x, y: 0..1 across the sensor, origin at the top
    left corner, y downwards (TUIO's and most panels' convention). Not checked: may be NaN.
    """

    id: int
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class TouchFrame:
    """All touches a source sees at a moment; a touch that is no longer in it has been lifted.

    time: when the news arrived, by the event loop's clock [s].
    """

    source: str
    time: float
    touches: tuple[Touch, ...]


class TouchSource(ABC):
    """Where touches come from; a source repeats its frame at least every 100 ms while touched."""

    @abstractmethod
    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver frames until cancelled or, for a recording, until its end.

        Malformed input is counted and logged, never raised.
        """
