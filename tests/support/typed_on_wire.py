"""`era rig ...` as typed, in virtual time, with a plate at the far end of a serial line."""

import asyncio
from collections.abc import Coroutine
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from controller.cli.commands import app
from model.rig.rig import Rig
from rig_on_wire import WIRES, far_side
from virtual_loop import run_virtual

PORT = "serial:///dev/memory0?baud=921600"
"""Where that line is."""


def typed_on_wire(patch: pytest.MonkeyPatch, on: Rig, *arguments: str) -> Result:
    """Type `era rig` with these arguments, on this plate; raises the command's error."""

    async def beside(main: Coroutine[Any, Any, Any]) -> Any:
        async with far_side(WIRES["serial"], on):
            return await main

    patch.setattr(asyncio, "run", lambda main: run_virtual(beside(main)))
    result = CliRunner().invoke(app, ["rig", *arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result
