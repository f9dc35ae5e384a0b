"""Touch sources: frames of all touches at one moment, and sources by the scheme of their URL."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import parse_qsl

from model.errors import InputError
from registry.plugins import Derived, PluginRegistry


@dataclass(frozen=True, slots=True)
class Touch:
    """One finger as reported by its source.

    id: constant from down to up; x, y: 0..1 across the sensor from its top left corner, y downwards
    (the convention of TUIO and most panels). Not validated: may be NaN. load: on the plate relative
    to the rig's fingertip, not bounded (`contacts`); None where nothing is reported.
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


def number_option(options: str, name: str, *, default: float) -> float:
    """Return the number of the only option that there may be; NaN for anything else."""
    given = dict(parse_qsl(options, keep_blank_values=True))
    text = given.pop(name, str(default))
    try:
        return math.nan if given else float(text)
    except ValueError:
        return math.nan


_SOURCES: PluginRegistry[Callable[[str], TouchSource]] = PluginRegistry(
    "touch source",
    "era_haptics.touch_sources",
    Derived(TouchSource),
    error=InputError,
    ending=":",
    example="tuio:127.0.0.1:3333",
)


def open_source(url: str) -> TouchSource:
    """Create the touch source of a URL such as `tuio:127.0.0.1:3333` or `evdev:/dev/input/event5`.

    Raises InputError for an unknown scheme, a failing plug-in or a URL that it refuses.
    """
    return _SOURCES.make(url)
