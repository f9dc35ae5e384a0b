"""Interface of touch sources: frames of all touches at one moment."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Touch:
    """One finger as reported by its source.

    id: constant from down to up; x, y: 0..1 across the sensor from its top left corner, y downwards
    (the convention of TUIO and most panels). Not validated: may be NaN. load: on the plate relative
    to the rig's fingertip, not bounded (`contact_load`); None where nothing is reported.
    """

    id: int
    x: float
    y: float
    load: float | None = None


@dataclass(frozen=True, slots=True)
class TouchFrame:
    """All touches of a source at one moment; a touch missing from it has been lifted.

    time: of arrival, by the event loop's clock [s]. timeout [s]: time without a frame of this
    source after which its touches are lifted; None: CONTACT_TIMEOUT. origin: the host or client,
    which may have several sources; None: the source itself.
    """

    source: str
    time: float
    touches: tuple[Touch, ...]
    timeout: float | None = None
    origin: str | None = None


class TouchSource(ABC):
    """Source of touch frames, repeated at least every 100 ms while there are touches.

    A source that cannot repeat them states a longer timeout in its frames.
    """

    @abstractmethod
    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """Deliver frames until cancelled or, for a recording, until its end.

        Malformed input must be counted and logged, not raised.
        """
