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
    from controller.api.async_client import AsyncClient as AsyncClient
    from controller.api.client import Client as Client
    from controller.api.client_protocol import LeaseLost as LeaseLost
    from controller.api.client_protocol import Notification as Notification
    from controller.api.client_protocol import Unreachable as Unreachable
    from controller.api.jsonrpc import NotSilent as NotSilent
    from controller.api.jsonrpc import RpcError as RpcError
    from drivers.by_hand.blocking import BlockingAmplifier as BlockingAmplifier
    from drivers.errors import CommandRefused as CommandRefused
    from drivers.errors import DriverError as DriverError
    from drivers.errors import LinkError as LinkError
    from era_haptics.amplifiers import commands_for as commands_for
    from era_haptics.amplifiers import open_amplifier as open_amplifier
    from era_haptics.calibration import calibrate as calibrate
    from era_haptics.designs import RankedLayout as RankedLayout
    from era_haptics.designs import design as design
    from era_haptics.drive import Drive as Drive
    from era_haptics.pictures import draw_contrast_map as draw_contrast_map
    from era_haptics.pictures import draw_map as draw_map
    from era_haptics.pictures import draw_pattern as draw_pattern
    from era_haptics.pictures import draw_playback as draw_playback
    from era_haptics.solved_plate import SolvedPlate as SolvedPlate
    from era_haptics.tables import answer as answer
    from era_haptics.tables import contrast_map as contrast_map
    from era_haptics.tables import query as query
    from era_haptics.tables import table as table
    from model.calibration.calibration_result import Calibration as Calibration
    from model.errors import InputError as InputError
    from model.finger.grid import Grid as Grid
    from model.reduction.reduced_plate import SupportedModes as SupportedModes
    from model.rig.file import example_rig_path as example_rig_path
    from model.rig.file import load_rig as load_rig
    from model.rig.rig import Rig as Rig
    from model.rig.uncertainty import Uncertainty as Uncertainty
    from model.structure.attachments import Fingertip as Fingertip
    from model.table.contrast_map import ContrastMap as ContrastMap
    from model.table.file import load_table as load_table
    from model.table.file import save_table as save_table
    from model.table.pattern import Pattern as Pattern
    from model.table.request import Answer as Answer
    from model.table.request import Finger as Finger
    from model.table.request import Request as Request
    from model.table.table import LocalizationTable as LocalizationTable
    from model.vibration.excitation import Tone as Tone
    from model.vibration.maps import PlateMap as PlateMap
    from registry.limits import GuardLimits as GuardLimits
    from sim.plant.playback import Playback as Playback

_NAMES = {
    "controller.api.async_client": "AsyncClient",
    "controller.api.client": "Client",
    "controller.api.client_protocol": "LeaseLost Notification Unreachable",
    "controller.api.jsonrpc": "NotSilent RpcError",
    "drivers.by_hand.blocking": "BlockingAmplifier",
    "drivers.errors": "CommandRefused DriverError LinkError",
    "era_haptics.amplifiers": "commands_for open_amplifier",
    "era_haptics.calibration": "calibrate",
    "era_haptics.drive": "Drive",
    "era_haptics.pictures": "draw_contrast_map draw_map draw_pattern draw_playback",
    "era_haptics.solved_plate": "SolvedPlate",
    "era_haptics.designs": "RankedLayout design",
    "era_haptics.tables": "answer contrast_map query table",
    "model.calibration.calibration_result": "Calibration",
    "model.errors": "InputError",
    "model.finger.grid": "Grid",
    "model.reduction.reduced_plate": "SupportedModes",
    "model.rig.file": "example_rig_path load_rig",
    "model.rig.rig": "Rig",
    "model.rig.uncertainty": "Uncertainty",
    "model.structure.attachments": "Fingertip",
    "model.table.contrast_map": "ContrastMap",
    "model.table.file": "load_table save_table",
    "model.table.pattern": "Pattern",
    "model.table.request": "Answer Finger Request",
    "model.table.table": "LocalizationTable",
    "model.vibration.excitation": "Tone",
    "model.vibration.maps": "PlateMap",
    "registry.limits": "GuardLimits",
    "sim.plant.playback": "Playback",
}
"""Names by the module that defines them."""

_HOMES = {name: module for module, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    """Load a name at its first use."""
    if name not in _HOMES:
        raise AttributeError(f"unknown name era_haptics.{name}; known are {', '.join(__all__)}")
    found = getattr(import_module(_HOMES[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """All names, for completion."""
    return __all__
