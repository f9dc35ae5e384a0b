"""Touch sources by the scheme of their URL: built in or from installed plug-ins."""

from collections.abc import Callable

from controller.sources.touch import TouchSource
from model.errors import InputError
from registry.plugins import Derived, PluginRegistry

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
