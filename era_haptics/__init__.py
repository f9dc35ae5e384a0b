"""Localized vibration from a notebook: `import era_haptics as era`.

Rigs, solved plates, maps, localization tables, patterns for fingers, playback in time, pictures,
amplifiers and clients of the daemon. Positions are in metres from the corner SW, x along the
plate's length, y along its width; other values are in SI units or have the unit in their name.
Invalid input raises InputError, a ValueError.

These names are stable; the packages behind them (`model`, `sim`, `drivers`, `controller`) change
without notice. A name is loaded at its first use, so that a client of the daemon does not wait for
linear algebra; `__init__.pyi` says from where, also to type checkers.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

from era_haptics.packages import check_packages, drop_foreign_backend

check_packages()
drop_foreign_backend()

_IMPORT = re.compile(r"^from (\S+) import (\w+(?:, \w+)*)", re.MULTILINE)
_NAME = re.compile(r"^from \S+ import (\w+) as (\w+)$|^(\w+) = (\w+)$", re.MULTILINE)
_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_MODULES = {own: module for module, names in _IMPORT.findall(_STUB) for own in names.split(", ")}
_OWN = {name or alias: own or known for own, name, alias, known in _NAME.findall(_STUB)}
_HOMES = {name: (_MODULES[own], own) for name, own in _OWN.items()}
"""The module that defines each name, and the name that it has there."""

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Load a name at its first use."""
    from registry.files import posix_needed

    if name not in _HOMES:
        raise AttributeError(f"unknown name era_haptics.{name}; known are {', '.join(__all__)}")
    try:
        module, own = _HOMES[name]
        found = getattr(import_module(module), own)
    except ModuleNotFoundError as error:
        if needed := posix_needed(error):
            raise ImportError(needed, name=error.name) from error
        raise
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """All names, for completion."""
    return __all__
