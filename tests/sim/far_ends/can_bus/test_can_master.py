"""A CANopen master of others, `canopen` over python-can's own socketcand, drives the far end."""

import asyncio
import struct
import time
from pathlib import Path

import canopen
import pytest

import drivers
from drivers.backends.urls.can_bus import CanUrl
from drivers.protocol.messages import AmplifierState, Fault
from model.rig.rig import Rig
from sim.far_ends.wires import Wire
from wires import far_side

DATA_SHEET = Path(drivers.__file__).parent.parent / "docs" / "reference" / "era-amplifier.eds"
HOST = 100
WATCHDOG = 600  # ms; shorter than the heartbeats go on
TIMEOUT = 5.0  # s; for a loaded machine, not an expectation


class Master:
    """Knows the data sheet, and from the vendor's page what goes into the PDOs."""

    def __init__(self, url: str) -> None:
        bus = CanUrl.parse(url).bus
        self.network = canopen.Network()
        self.network.NOTIFIER_CYCLE = 0.05
        self.network.connect(
            interface="socketcand",
            channel=bus.channel,
            host=bus.host,
            port=bus.port,
            ignore_config=True,
        )
        self.node = self.network.add_node(1, str(DATA_SHEET))

    def close(self) -> None:
        """Leave the bus."""
        self.network.disconnect()

    def session(self) -> tuple[float, ...]:
        """Start, arm, play two channels on SYNC, feed the watchdog; the levels as read back."""
        node = self.node
        node.nmt.wait_for_heartbeat(TIMEOUT)
        node.nmt.state = "OPERATIONAL"
        node.nmt.wait_for_heartbeat(TIMEOUT)
        assert node.nmt.state == "OPERATIONAL"
        order = struct.pack("<HHHBB", HOST, 0, WATCHDOG, 4, 1)  # arm
        node.sdo["order"].raw = int.from_bytes(order, "little")
        assert node.sdo["heartbeat_consumer"][1].raw == HOST << 16 | WATCHDOG
        for channel, level in ((0, 2500), (3, 5000)):
            command = struct.pack("<HHhBB", 11000, level, 0, channel << 4, 2)
            self.network.send_message(0x201 + 0x100 * channel, command)
        self.network.send_message(0x481, struct.pack("<HHHBB", 7, 0, 0, 1 | 2 << 3, 2))
        self.network.sync.transmit()
        for _ in range(8):
            time.sleep(0.1)
            self.network.send_message(0x700 + HOST, b"\x05")
        assert node.sdo["status"]["active_token"].raw == 7
        return tuple(node.sdo["channel_levels"][channel].raw / 10_000 for channel in range(1, 5))

    def wait_for_emergency(self) -> tuple[int, int]:
        """Code and error register of the next."""
        error = self.node.emcy.wait(timeout=TIMEOUT)
        assert error is not None
        return error.code, error.register


async def test_node_is_driven_by_a_canopen_master(coarse_rig: Rig) -> None:
    """By EDS and page alone: it plays a set, and sends EMCY 8130 without heartbeats."""
    async with far_side(Wire(kind="socketcand"), coarse_rig) as far:
        master = await asyncio.to_thread(Master, far.url)
        try:
            levels = await asyncio.to_thread(master.session)
            assert levels == pytest.approx((0.25, 0.0, 0.0, 0.5))
            waiting = asyncio.create_task(asyncio.to_thread(master.wait_for_emergency))
            async with asyncio.timeout(TIMEOUT):
                while (  # noqa: ASYNC110  only polling advances the time
                    far.device.status().fault is not Fault.WATCHDOG
                ):
                    await asyncio.sleep(0.01)
            assert await waiting == (0x8130, 0x11)
            assert far.amplifier.state in (
                AmplifierState.FAULT_REACTION_ACTIVE,
                AmplifierState.FAULT,
            )
        finally:
            await asyncio.to_thread(master.close)
