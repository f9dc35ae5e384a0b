"""Simulated amplifiers in this process, by URLs `sim://`.

Requests and replies are the bytes of a serial line. Not modelled: transmission time.
"""

import asyncio
import contextlib
import random
from collections.abc import Callable, Sequence

from drivers.errors import LinkError
from drivers.host.serial_wire import SerialWire
from drivers.wires.address import WireAddress
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.shared_rig import SimulationUrl, opened
from sim.transport.line import TwoWayLine


class MemoryPort:
    """The port of a host, with devices at the addresses of their numbers at the other end.

    It works in the running event loop. on_data: called with what they send; on_loss: called once
    with the cause when the first device is unplugged. Raises LinkError while it is.
    """

    is_blocked = False

    def __init__(
        self,
        devices: Sequence[AmplifierDevice],
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._first = devices[0]
        if not self._first.is_plugged:
            raise LinkError(f"amplifier {self._first.name} is unplugged")
        self._on_data, self._on_loss = on_data, on_loss
        self._end = SerialAmplifiers(
            {each.address: each for each in devices}, lambda data: self._wire.outward.send(data)
        )
        self._wire = TwoWayLine(
            to_amplifier=self._end.receive,
            to_host=self._deliver,
            faults=self._first.faults,
        )
        self._running = contextlib.AsyncExitStack()
        self._is_open = True
        self._first.plug_listeners.append(self._plug)

    def closes_with(self, running: contextlib.AsyncExitStack) -> None:
        """Have it end what runs for it when it is closed."""
        self._running = running

    def write(self, data: bytes) -> None:
        """Send bytes to the amplifiers; raises LinkError if it is lost."""
        if not self._is_open:
            raise LinkError(f"amplifier {self._first.name} was unplugged")
        self._wire.inward.send(data)

    def poll(self) -> None:
        """Do nothing: what has come was handed over."""

    def close(self) -> None:
        """Close it; disarm before, or vibrations last until the watchdogs trip."""
        if self._is_open:
            self._is_open = False
            self._first.plug_listeners.remove(self._plug)
            self._end.close()
            self._wire.close()

    async def wait_closed(self) -> None:
        """End what runs for it."""
        await self._running.aclose()

    def _deliver(self, data: bytes) -> None:
        # Never while the host still writes the request.
        asyncio.get_running_loop().call_soon(self._arrived, data)

    def _arrived(self, data: bytes) -> None:
        if self._is_open:
            self._on_data(data)

    def _plug(self, is_plugged: bool) -> None:
        if not is_plugged:
            self.close()
            self._on_loss(f"amplifier {self._first.name} was unplugged")


class SimulatedAddress(WireAddress):
    """An amplifier of a rig simulated in this process, alone on its line; see `SimulationUrl`."""

    def __init__(self, url: str) -> None:
        self._url = SimulationUrl(url)
        self.line, self.number = url, 1
        self.settings = {"protocol": "serial"}

    def make_wire(self) -> SerialWire:
        """Make the wire; a random start, so that a reply to an earlier host does not match."""
        return SerialWire(0, sequence=random.getrandbits(16))

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> MemoryPort:
        """Simulate the rig, its plate at rest, or share it; raises CommandError, LinkError.

        The last port of a rig that is closed ends its simulation.
        """
        async with contextlib.AsyncExitStack() as stack:
            context, name = await stack.enter_async_context(opened(self._url))
            device = context.devices.get(name)
            if not isinstance(device, AmplifierDevice):
                device = AmplifierDevice(context.bench, name)
                context.devices = {**context.devices, name: device}
            port = MemoryPort([device], on_data, on_loss)
            port.closes_with(stack.pop_all())
            return port
