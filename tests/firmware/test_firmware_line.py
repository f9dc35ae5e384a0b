"""The host of protocol 3 and the firmware on every kind of line, in virtual time."""

import asyncio
from pathlib import Path

import numpy as np
import pytest

from drivers.contents import Layer, Shape, Tone
from drivers.errors import LinkError
from drivers.host.group import Group
from drivers.protocol.table import FAULTS, STATES
from firmware_line import LINES, FirmwareLine
from moved_firmware import RATE
from virtual_loop import run_virtual

WATCHDOG = 0.25  # s
ONSET = Shape(0.01, tuple(0.1 * n for n in range(1, 5)))


def layers(ramp: float = 0.02) -> list[Layer]:
    """Two fingers: a set of two layers whose onsets need several messages on CAN and Modbus."""
    one = Tone(0, 100.0, 0.5, onset=ONSET, ending=ONSET)
    return [
        Layer(0, (one, *(Tone(n, 130.0, 0.3, onset=ONSET) for n in (1, 2, 3))), ramp),
        Layer(3, tuple(Tone(n, 250.0, 0.2, onset=ONSET) for n in range(4)), ramp),
    ]


@pytest.mark.parametrize("kind", LINES)
def test_host_that_vanishes_leaves_silence(kind: str, replaying: Path) -> None:
    """Silent within the watchdog and 5 ms of the last heartbeat; the host says that it is lost."""

    async def run() -> None:
        end = FirmwareLine(kind, replaying)
        group = Group({"a": end.host}, watchdog=WATCHDOG)
        await group.open()
        await group.arm()
        await group.apply({"a": layers()})
        for _ in range(4):
            await asyncio.sleep(0.05)
            await group.beat()
        end.firmware.samples()
        end.is_deaf = True
        with pytest.raises(LinkError):
            await group.beat()
        await asyncio.sleep(0.5)
        samples = np.abs(end.firmware.samples()).max(axis=1)
        assert samples[: round(0.2 * RATE)].max() > 0.5
        assert not samples[round((WATCHDOG + 0.005) * RATE) :].any()
        end.is_deaf = False
        status = await end.host.read_status()
        assert (status["state"], status["fault"]) == (STATES["FAULT"], FAULTS["WATCHDOG"])

    run_virtual(run())
