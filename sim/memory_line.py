"""Lines of protocol 3 to simulated amplifiers in this process, and the `sim://` URLs of them.

Requests and replies are the bytes of a serial line. Not modelled: transmission time.
"""

import asyncio
import contextlib
import random
from collections.abc import Sequence

from drivers import clock
from drivers.errors import LinkError
from drivers.host.line import Line
from drivers.host.serial_wire import SerialWire
from sim.amplifier.contract import Amplifier
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.shared_rig import SimulationUrl, opened
from sim.transport.line import TwoWayLine


class MemoryLine:
    """A line with devices at the addresses of their numbers, in the running event loop.

    line: the host's side, lost when the first device is unplugged. Raises LinkError while it is.
    """

    is_blocked = False

    def __init__(self, devices: Sequence[AmplifierDevice], name: str) -> None:
        self._first = devices[0]
        if not self._first.is_plugged:
            raise LinkError(f"{name} is unplugged")
        self._end = SerialAmplifiers({each.address: each for each in devices}, self._reply)
        self._wire = TwoWayLine(
            to_amplifier=lambda data: self._end.receive(data, clock.now()),
            to_host=self._deliver,
            faults=self._first.faults,
        )
        self._first.plug_listeners.append(self._plug)
        # A random start, so that a reply to an earlier host does not match.
        sequence = random.getrandbits(16)
        self.line = Line(SerialWire(0, sequence=sequence), self, name)

    def write(self, data: bytes) -> None:
        """Send bytes to the amplifiers."""
        self._wire.inward.send(data)

    def poll(self) -> None:
        """Do nothing: what has come was handed over."""

    def close(self) -> None:
        """Close it; disarm before, or vibrations last until the watchdogs trip."""
        if self._plug in self._first.plug_listeners:
            self._first.plug_listeners.remove(self._plug)
            self._end.close()
            self._wire.close()
        if self.line.loss is None:
            self.line.lose(f"{self.line.name} was closed")

    def _reply(self, data: bytes) -> None:
        self._wire.outward.send(data)

    def _deliver(self, data: bytes) -> None:
        # Never while the host still writes the request.
        asyncio.get_running_loop().call_soon(self._arrived, data)

    def _arrived(self, data: bytes) -> None:
        if self.line.loss is None:
            self.line.received(data)

    def _plug(self, is_plugged: bool) -> None:
        if not is_plugged:
            self.line.lose(f"{self.line.name} was unplugged")


class SimulatedLine:
    """The line of an amplifier by its URL; see `SimulationUrl`. It is alone on it, at address 1."""

    address = 1

    def __init__(self, memory: MemoryLine, stack: contextlib.AsyncExitStack) -> None:
        self.line = memory.line
        self._memory = memory
        self._stack = stack

    @classmethod
    async def open(cls, url: str) -> "SimulatedLine":
        """Simulate the rig of a URL, its plate at rest; raises CommandError, LinkError."""
        async with contextlib.AsyncExitStack() as stack:
            context, name = await stack.enter_async_context(
                opened(SimulationUrl.parse(url), Amplifier)
            )
            device = context.devices.get(name)
            if not isinstance(device, AmplifierDevice):
                device = AmplifierDevice(context.bench, name)
                context.devices = {**context.devices, name: device}
            memory = MemoryLine([device], url)
            return cls(memory, stack.pop_all())

    async def close(self) -> None:
        """Close the line; the last one of a rig ends its simulation."""
        self._memory.close()
        await self._stack.aclose()
