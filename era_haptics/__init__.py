"""Localized vibration from a notebook: `import era_haptics as era`.

Rigs, solved plates, maps, localization tables, patterns for fingers, playback in time, pictures,
amplifiers and clients of the daemon. Positions are in metres from the corner SW, x along the
plate's length, y along its width; other values are in SI units or have the unit in their name.
Invalid input raises InputError, a ValueError.

These names are stable; the packages behind them (`model`, `sim`, `drivers`, `controller`) change
without notice. A name is loaded at its first use, so that a client of the daemon does not wait for
linear algebra.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from controller.api.async_client import AsyncClient
    from controller.api.client import Client
    from controller.api.client_protocol import Notification, Unreachable
    from controller.api.jsonrpc import RpcError
    from drivers.blocking import BlockingAmplifier
    from drivers.command import DriveCommand
    from drivers.errors import CommandRefused, DriverError, LinkError
    from drivers.guard import GuardLimits
    from era_haptics.amplifiers import commands_for, open_amplifier
    from era_haptics.drive import Drive
    from era_haptics.pictures import draw_map, draw_pattern, draw_playback
    from era_haptics.solved_plate import SolvedPlate
    from era_haptics.tables import query, table
    from model.errors import InputError
    from model.finger.grid import Grid
    from model.finger.load import FingerLoad
    from model.reduction.supported_modes import SupportedModes
    from model.rig.file import example_rig_path, load_rig
    from model.rig.rig import Rig
    from model.table.file import load_table, save_table
    from model.table.pattern import Pattern
    from model.table.table import LocalizationTable
    from model.vibration.excitation import Tone
    from model.vibration.maps import PlateMap
    from sim.plant.playback import Playback

_HOMES = {
    "AsyncClient": "controller.api.async_client",
    "BlockingAmplifier": "drivers.blocking",
    "Client": "controller.api.client",
    "CommandRefused": "drivers.errors",
    "Drive": "era_haptics.drive",
    "DriveCommand": "drivers.command",
    "DriverError": "drivers.errors",
    "FingerLoad": "model.finger.load",
    "Grid": "model.finger.grid",
    "GuardLimits": "drivers.guard",
    "InputError": "model.errors",
    "LinkError": "drivers.errors",
    "LocalizationTable": "model.table.table",
    "Notification": "controller.api.client_protocol",
    "Pattern": "model.table.pattern",
    "PlateMap": "model.vibration.maps",
    "Playback": "sim.plant.playback",
    "Rig": "model.rig.rig",
    "RpcError": "controller.api.jsonrpc",
    "SolvedPlate": "era_haptics.solved_plate",
    "SupportedModes": "model.reduction.supported_modes",
    "Tone": "model.vibration.excitation",
    "Unreachable": "controller.api.client_protocol",
    "commands_for": "era_haptics.amplifiers",
    "draw_map": "era_haptics.pictures",
    "draw_pattern": "era_haptics.pictures",
    "draw_playback": "era_haptics.pictures",
    "example_rig_path": "model.rig.file",
    "load_rig": "model.rig.file",
    "load_table": "model.table.file",
    "open_amplifier": "era_haptics.amplifiers",
    "query": "era_haptics.tables",
    "save_table": "model.table.file",
    "table": "era_haptics.tables",
}

__all__ = [
    "AsyncClient",
    "BlockingAmplifier",
    "Client",
    "CommandRefused",
    "Drive",
    "DriveCommand",
    "DriverError",
    "FingerLoad",
    "Grid",
    "GuardLimits",
    "InputError",
    "LinkError",
    "LocalizationTable",
    "Notification",
    "Pattern",
    "PlateMap",
    "Playback",
    "Rig",
    "RpcError",
    "SolvedPlate",
    "SupportedModes",
    "Tone",
    "Unreachable",
    "commands_for",
    "draw_map",
    "draw_pattern",
    "draw_playback",
    "example_rig_path",
    "load_rig",
    "load_table",
    "open_amplifier",
    "query",
    "save_table",
    "table",
]


def __getattr__(name: str) -> Any:
    """Load a name at its first use."""
    if name not in _HOMES:
        raise AttributeError(f"unknown name era_haptics.{name}; known are {', '.join(__all__)}")
    found = getattr(import_module(_HOMES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """All names, for completion."""
    return list(__all__)
