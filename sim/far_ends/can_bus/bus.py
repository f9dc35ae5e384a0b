"""A CAN bus within this process: a frame of one member is received by all others, at one time.

Not modelled: arbitration, retransmission, bus-off.
"""

import asyncio
from collections.abc import Callable, Sequence

from drivers.wires.can_frames import CanFrame, pack_frames, unpack_frames
from registry import threads
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.can_bus.amplifiers import CanAmplifiers
from sim.transport.far_end import Served
from sim.transport.line import TwoWayLine

Listener = Callable[[CanFrame], None]

_OVERHEAD = 8  # bytes of a frame beside its data, about, with stuffing and gap


class CanBus:
    """A bus whose members are identified by their listeners.

    bitrate [bit/s]: None for no transmission time.
    """

    def __init__(self, bitrate: int | None = None) -> None:
        self._members: list[Listener] = []
        self._bitrate = bitrate
        self._free_from = 0.0
        self._in_flight: set[asyncio.TimerHandle] = set()

    def join(self, listener: Listener) -> None:
        """Add a member."""
        self._members.append(listener)

    def leave(self, listener: Listener) -> None:
        """Remove a member, if it is one."""
        if listener in self._members:
            self._members.remove(listener)

    def send(self, frame: CanFrame, *, sender: Listener) -> None:
        """Deliver a frame to all but its sender, after the frames that were sent before."""
        if self._bitrate is None:
            self._deliver(frame, sender)
            return

        def arrive() -> None:
            self._in_flight.discard(timer)
            self._deliver(frame, sender)

        bits = 8 * (_OVERHEAD + len(frame.data))
        self._free_from = max(threads.now(), self._free_from) + bits / self._bitrate
        timer = asyncio.get_running_loop().call_at(self._free_from, arrive)
        self._in_flight.add(timer)

    def close(self) -> None:
        """Discard the frames in flight."""
        for timer in self._in_flight:
            timer.cancel()
        self._in_flight.clear()

    def _deliver(self, frame: CanFrame, sender: Listener) -> None:
        for member in tuple(self._members):
            if member != sender:
                member(frame)


class BusNodes:
    """Amplifiers on a bus, each at the node of its number, with faults of its own each way.

    A damaged frame fails its CRC and is dropped. All take a frame at one time, however long a
    simulation needs.
    """

    def __init__(self, bus: CanBus, devices: Sequence[AmplifierDevice]) -> None:
        self._bus = bus
        self._nodes = [self._connect(device) for device in devices]
        bus.join(self._hear)

    def close(self) -> None:
        """Leave the bus and discard frames in flight."""
        self._bus.leave(self._hear)
        for line, served in self._nodes:
            line.close()
            served.close()

    def _hear(self, frame: CanFrame) -> None:
        now = threads.now()
        for line, _ in self._nodes:
            line.inward.send(pack_frames([frame]), now)

    def _leave(self, data: bytes) -> None:
        for frame in unpack_frames(data):
            self._bus.send(frame, sender=self._hear)

    def _connect(self, device: AmplifierDevice) -> tuple[TwoWayLine, Served]:
        def send(frames: bytes) -> None:
            for frame in unpack_frames(frames):
                line.outward.send(pack_frames([frame]))

        def boot() -> None:
            end.start(threads.now())
            served.schedule()

        line = TwoWayLine(
            to_amplifier=lambda data, now: served.receive(data, now),
            to_host=self._leave,
            faults=device.faults,
            finds_damage=True,
        )
        end = CanAmplifiers({device.address: device}, send)
        served = Served(end)
        device.boot_listeners.append(boot)
        boot()
        return line, served
