"""The amplifiers' side of a CAN bus: nodes, and the adapter for the host."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager

from drivers import clock
from drivers.codec.can_bus.canopen import BITRATE
from drivers.codec.can_bus.segments import pack_frames, unpack_frames
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.can_bus.amplifiers import CanAmplifiers
from sim.far_ends.can_bus.bus import CanBus, Stub
from sim.far_ends.can_bus.slcan_adapter import SlcanEnd
from sim.far_ends.can_bus.socketcand_server import BUS_NAME, SocketcandEnd
from sim.transport.far_end import Served


@asynccontextmanager
async def nodes_on(
    bus: CanBus, devices: Sequence[AmplifierDevice]
) -> AsyncIterator[dict[str, int]]:
    """Put amplifiers on a bus; yields the node of each by name."""
    with contextlib.ExitStack() as stack:
        for device in devices:
            stack.enter_context(_amplifier_on(bus, device))
        yield {device.name: device.address for device in devices}


@asynccontextmanager
async def socketcand(
    devices: Sequence[AmplifierDevice], *, port: int = 0, bitrate: int | None = None
) -> AsyncIterator[Mapping[str, str]]:
    """Serve amplifiers on one bus by socketcand; yields their URLs by name."""
    bus = CanBus(bitrate)
    end = SocketcandEnd(bus, port=port)
    opening: set[asyncio.Task[None]] = set()

    def plug(is_plugged: bool) -> None:
        if not is_plugged:
            end.unplug()
        else:
            task = asyncio.get_running_loop().create_task(end.open())
            opening.add(task)
            task.add_done_callback(opening.discard)

    async with AsyncExitStack() as stack:
        stack.callback(bus.close)
        await end.open()
        stack.push_async_callback(end.close)
        nodes = await stack.enter_async_context(nodes_on(bus, devices))
        devices[0].on_plug(plug)
        speed = f"?bitrate={bitrate}" if bitrate not in (None, BITRATE) else ""
        yield {
            name: f"can+socketcand://127.0.0.1:{end.port}/{BUS_NAME}{speed}#{node}"
            for name, node in nodes.items()
        }
        await asyncio.gather(*opening)


@asynccontextmanager
async def slcan(
    devices: Sequence[AmplifierDevice], *, bitrate: int | None = None, unpluggable: bool = False
) -> AsyncIterator[Mapping[str, str]]:
    """Serve amplifiers on one bus behind a serial adapter; yields their URLs by name."""
    bus = CanBus(bitrate)
    end = SlcanEnd(bus, unpluggable=unpluggable)
    async with AsyncExitStack() as stack:
        stack.callback(bus.close)
        stack.callback(end.close)
        nodes = await stack.enter_async_context(nodes_on(bus, devices))
        devices[0].on_plug(end.plug)
        yield {
            name: f"can+slcan://{end.path}?bitrate={bitrate or BITRATE}#{node}"
            for name, node in nodes.items()
        }


@contextlib.contextmanager
def _amplifier_on(bus: CanBus, device: AmplifierDevice) -> Iterator[None]:
    """Put an amplifier on a bus, at the node of its number."""

    def send(frames: bytes) -> None:
        for frame in unpack_frames(frames):
            stub.send(frame)

    def boot() -> None:
        end.start(clock.now())
        served.schedule()

    stub = Stub(bus, lambda frame: served.receive(pack_frames([frame])), faults=device.faults)
    end = CanAmplifiers({device.address: device}, send)
    served = Served(end, bus.time.now)
    device.on_boot(boot)
    boot()
    try:
        yield
    finally:
        served.close()
        stub.close()
