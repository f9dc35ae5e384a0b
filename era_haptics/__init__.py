"""Localized vibration from a notebook: `import era_haptics as era`.

Rigs, solved plates, maps, localization tables, patterns for fingers, playback in time, pictures,
amplifiers and clients of the daemon. Positions are in meters from the corner SW, x along the
plate's length, y along its width; other values are in SI units or have the unit in their name.
Invalid input raises InputError, a ValueError.

These names are stable; the packages behind them (`model`, `sim`, `drivers`, `controller`) change
without notice. A name is loaded at its first use, so that a client of the daemon does not wait for
linear algebra; `__init__.pyi` defines from where, also for type checkers.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

from era_haptics.packages import check_packages, drop_foreign_backend

check_packages()
drop_foreign_backend()


def _homes() -> dict[str, tuple[str, str]]:
    """The module that defines each public name, and its name there, from the stub.

    Public are `from MODULE import NAME as NAME` and `NAME = IMPORTED`, as for type checkers.
    `lazy_loader.attach_stub` does the same for modules within one package only.
    """
    stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    imported: dict[str, tuple[str, str]] = {}
    homes: dict[str, tuple[str, str]] = {}
    for statement in ast.parse(stub).body:
        match statement:
            case ast.ImportFrom(module=str(module), names=aliases):
                for alias in aliases:
                    imported[alias.name] = (module, alias.name)
                    if alias.asname:
                        homes[alias.asname] = imported[alias.name]
            case ast.Assign(targets=[ast.Name(id=public)], value=ast.Name(id=name)):
                homes[public] = imported[name]
    return homes


_HOMES = _homes()
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Load a name at its first use."""
    from registry.files import posix_needed

    if name not in _HOMES:
        raise AttributeError(f"unknown name era_haptics.{name}; known: {', '.join(__all__)}")
    try:
        module, name_there = _HOMES[name]
        value = getattr(import_module(module), name_there)
    except ModuleNotFoundError as error:
        if needed := posix_needed(error):
            raise ImportError(needed, name=error.name) from error
        raise
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """All names, for completion."""
    return __all__
