"""A chain with a table that a test sets, on a rig for which nothing has to be solved."""

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, TypeVar

from chain import Chain
from model.vibration import Tone
from registry.limits import GuardLimits
from set_table import SetTable, make_rig
from sim.far_ends.wire_assignment import Wire

Made = TypeVar("Made", bound=Chain)

FINGER = (1, 0.15, 0.1)
OTHER = (2, 0.27, 0.02)
"""Fingers on these rigs."""


@asynccontextmanager
async def set_chain(
    *amplifiers: str,
    of: type[Made] = Chain,  # type: ignore[assignment]
    wire: str = "serial",
    rate: float = math.inf,
    on_time: float = math.inf,
    knots: int = 0,
    **options: Any,
) -> AsyncIterator[Made]:
    """A chain with a table that a test sets, not open yet; one amplifier unless more are named.

    of: its class; wire: its kind; rate [1/s], on_time [s]: limits of the rig; knots: of an
    envelope, none that can be played without; options: as for `Chain.on`. Its wires have no delays,
    its fingers load no plate.
    """
    names = amplifiers or ("main",)
    rig = make_rig(names, GuardLimits(40.0, 500.0, 1.0, rate=rate, on_time=on_time))
    table = SetTable({"SW": Tone(110.0, 20e-6, math.pi / 2)}, rig.plate)
    options = {"passing": (0.0, 0.0), "capabilities": {"knots": knots}, **options}
    async with of.on(Wire(wire, unpluggable=True), rig, table, **options) as chain:
        chain.is_felt = chain.must_be_felt = False
        yield chain


@asynccontextmanager
async def set_running(
    *amplifiers: str, of: type[Made] = Chain, breaks: str | None = None, **options: Any
) -> AsyncIterator[Made]:
    """The same, armed, and judged at its end; breaks: the only rule that is broken."""
    async with set_chain(*amplifiers, of=of, **options) as chain:
        await chain.open()
        await chain.operate("arm")
        await asyncio.sleep(0.001)
        yield chain
        await chain.close()
        chain.judge(breaks)
