"""Backends by the scheme of a URL.

Backends are the entry points of the group `era_haptics.backends`, named by scheme; each is a class
derived from `Backend`, and made with the URL.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from drivers.backend import Backend
from drivers.errors import CommandError
from drivers.voltage import VoltageBackend
from registry.plugins import Derived, PluginRegistry
from registry.voltage import VoltageDrive

_BACKENDS: PluginRegistry[Callable[[str], Backend]] = PluginRegistry(
    "backend",
    "era_haptics.backends",
    Derived(Backend),
    error=CommandError,
    ending="://",
    example="serial:///dev/ttyUSB0?baud=921600",
)


def known_schemes() -> tuple[str, ...]:
    """Return the installed URL schemes, sorted."""
    return _BACKENDS.names()


def open_backend(url: str, voltage: Mapping[int, VoltageDrive] = MappingProxyType({})) -> Backend:
    """Make the backend of a URL, not yet open; CommandError for an unknown or invalid URL.

    voltage: by channel, for an amplifier whose levels are of a voltage; empty for one of motion.
    """
    backend = _BACKENDS.make(url)
    return VoltageBackend(backend, voltage) if voltage else backend
