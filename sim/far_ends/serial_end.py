"""The amplifiers' side of a serial line: a pseudo-terminal in front of simulated amplifiers.

On a shared (multi-drop) line amplifiers have one address each, and send no events.

Not modelled: noise, parity, collisions.
"""

import contextlib
from collections.abc import Sequence

from drivers.codec.payload import Malformed
from drivers.codec.serial_line.exchanges import decode_request, encode_event, encode_reply
from drivers.codec.serial_line.frame import Frame, FrameCounters, FrameReader, encode_frame
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import (
    AddressSet,
    AmplifierEvent,
    Commit,
    Nak,
    Reply,
    SetAddress,
    Stop,
)
from sim.bench.simulated_device import SimulatedDevice
from sim.transport.frame_time import FrameTime
from sim.transport.line import TwoWayLine
from sim.transport.pseudo_terminal import make_terminal


class SerialEnd:
    """A pseudo-terminal with devices at the addresses of their numbers.

    baud: None for no transmission time; unpluggable: see `make_terminal`.
    """

    def __init__(
        self,
        devices: Sequence[SimulatedDevice],
        *,
        baud: int | None = None,
        unpluggable: bool = False,
    ) -> None:
        alone = len(devices) == 1
        self._devices = list(devices)
        self._addresses = {
            device.name: PROTOCOL.serial.address if alone else device.address for device in devices
        }
        self._time = FrameTime()
        for device in devices:
            device.time = self._time.now
        self._first = devices[0]
        self._baud = baud or PROTOCOL.serial.baud
        self._line = TwoWayLine(
            to_amplifier=self._arrived,
            to_host=self._to_host,
            faults=self._first.faults,
            bits_per_second=baud,
        )
        self._events = 0
        self._reader = FrameReader()
        self._terminal = make_terminal(self._line.inward.send, unpluggable=unpluggable)
        self._is_unpluggable = unpluggable

    @property
    def port(self) -> str:
        """The path of the host's side."""
        return self._terminal.port

    @property
    def dropped_replies(self) -> int:
        """Replies lost because the host did not read."""
        return self._terminal.dropped

    @property
    def urls(self) -> dict[str, str]:
        """The URL of each amplifier, by its name."""
        first = PROTOCOL.serial.address
        return {
            device.name: f"serial://{self.port}?baud={self._baud}"
            + (f"&address={address}" if (address := self._addresses[device.name]) != first else "")
            for device in self._devices
        }

    @property
    def counters(self) -> FrameCounters:
        """Counters of received frames."""
        return self._reader.counters

    def start(self) -> None:
        """Serve in the running event loop."""
        self._terminal.listen()
        if self._is_unpluggable:
            self._first.on_plug(self._plug)
        if len(self._devices) == 1:
            self._first.listen(self._send_event)

    def close(self) -> None:
        """Close, in the event loop of `start`."""
        self._line.close()
        self._terminal.close()

    def _plug(self, is_plugged: bool) -> None:
        """Unplug the line, or plug it in again."""
        self._line.close()
        self._terminal.plug(is_plugged)

    def _arrived(self, data: bytes) -> None:
        for frame in self._reader.feed(data):
            if frame.is_reply:  # an echo
                continue
            if frame.address == PROTOCOL.serial.broadcast:
                self._broadcast(frame)
                continue
            for device in self._devices:
                if self._addresses[device.name] != frame.address:
                    continue
                reply = self._answer(frame, device)
                if reply is not None:
                    self._line.outward.send(encode_frame(encode_reply(reply, frame)))
                self._note_address(device, reply)

    def _answer(self, frame: Frame, device: SimulatedDevice) -> Reply | None:
        try:
            request = decode_request(frame)
        except Malformed as problem:
            return Nak(problem.code, problem.channel) if device.is_answering else None
        return device.exchange(request)

    def _broadcast(self, frame: Frame) -> None:
        with contextlib.suppress(Malformed), self._time.in_one_frame():
            request = decode_request(frame)
            if isinstance(request, Commit | Stop | SetAddress):
                for device in self._devices:
                    self._note_address(device, device.broadcast(request))

    def _note_address(self, device: SimulatedDevice, reply: Reply | None) -> None:
        """Note the address that an amplifier has taken."""
        if isinstance(reply, AddressSet):
            self._addresses[device.name] = reply.address

    def _send_event(self, event: AmplifierEvent) -> None:
        if self._first.is_answering:
            self._events = (self._events + 1) & 0xFFFF
            address = self._addresses[self._first.name]
            frame = encode_event(event, address=address, sequence=self._events)
            self._line.outward.send(encode_frame(frame))

    def _to_host(self, data: bytes) -> None:
        self._terminal.write(data)
