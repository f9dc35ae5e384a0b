"""Modbus: modbus+tcp://HOST:PORT/UNIT and modbus+rtu:///dev/ttyS1?baud=115200#UNIT.

RTU goes over a port that keeps the line silent before each frame.
"""

import asyncio
import contextlib
import random
from collections.abc import Callable
from dataclasses import replace
from typing import final

from drivers.errors import LinkError
from drivers.ports.port import Port
from drivers.ports.serial_port import open_port
from drivers.protocol.timing import BOOT_TIME
from drivers.urls import ADDRESS, ADDRESS_MAX, RTU_BAUD, AmplifierUrl
from drivers.wires.address import PortAbove, WireAddress
from drivers.wires.modbus.host import ModbusWire
from drivers.wires.wire import NETWORK_DELAY

_FRAME_MAX = 256  # bytes
_BROADCAST = b"\0"


@final
class SilentPort(PortAbove):
    """A port that sends a frame once the line was silent for a time [s]; implements `Port`.

    byte_time [s]; on_data: called with what is received. A frame waits at most for the longest
    other one, so that noise does not keep a stop waiting, but always for one of its own.
    Of those that wait a newer one replaces the older: its request was given up. Broadcasts stay,
    which have no reply to wait for.
    """

    def __init__(self, silence: float, byte_time: float, on_data: Callable[[bytes], None]) -> None:
        self._silence, self._byte_time, self._on_data = silence, byte_time, on_data
        self._loop = asyncio.get_running_loop()
        self._free_from = self._loop.time() + silence
        self._sent_until = 0.0  # s; the end of the last frame of its own, and silence
        self._waiting: list[tuple[float, bytes]] = []  # until when [s] at most, frame
        self._timer: asyncio.TimerHandle | None = None

    def write(self, data: bytes) -> None:
        """Send a frame as soon as the line was silent; raises LinkError."""
        latest = self._loop.time() + _FRAME_MAX * self._byte_time + self._silence
        kept = [each for each in self._waiting if each[1].startswith(_BROADCAST)]
        self._waiting = [*kept, (latest, data)]
        self._send()

    def close(self) -> None:
        """Close it; what waits is not sent."""
        self._waiting.clear()
        super().close()

    def received(self, data: bytes) -> None:
        """Take what was received, and count it as noise on the line."""
        self._free_from = max(self._free_from, self._loop.time() + self._silence)
        self._on_data(data)

    def _send(self) -> None:
        """Send what may go now; the timer sends the rest."""
        while self._waiting:
            latest, frame = self._waiting[0]
            due = max(self._sent_until, min(self._free_from, latest))
            now = self._loop.time()
            if now < due:
                if self._timer is None:
                    self._timer = self._loop.call_at(due, self._due)
                return
            del self._waiting[0]
            self._sent_until = now + len(frame) * self._byte_time + self._silence
            self._free_from = max(self._free_from, self._sent_until)
            self.below.write(frame)

    def _due(self) -> None:
        self._timer = None
        with contextlib.suppress(LinkError):  # the loss of the port is reported by itself
            self._send()


_TCP_FORM = "modbus+tcp://HOST:PORT/UNIT (behind a gateway: ?baud=38400, that of its line)"
_RTU_FORM = "modbus+rtu:///dev/ttyS1?baud=115200#UNIT or modbus+rtu://HOST:PORT#UNIT"
_TCP_PORT = 502
_PARITIES = {"even": "E", "odd": "O", "none": "N"}


class ModbusAddress(WireAddress):
    """A unit over TCP, on a serial port of this machine, or behind a serial server."""

    def __init__(self, url: str) -> None:
        self._is_rtu = url.lower().startswith("modbus+rtu")
        if self._is_rtu:
            parsed = AmplifierUrl(url, _RTU_FORM, known=("baud", "parity", "stop"))
            number = "unit must be given as #{}"
            place = parsed.server(number=number) if parsed.place else parsed.device(RTU_BAUD)
            unit = parsed.number
        else:
            parsed = AmplifierUrl(url, _TCP_FORM, known=("baud",))
            parsed.require(
                not parsed.number, f"unit must be given as /{parsed.number} behind the host"
            )
            place, unit = parsed.server(port=_TCP_PORT), parsed.path.strip("/")
        parity = parsed.options.get("parity", "even")
        parsed.require(
            parity in _PARITIES, f"parity must be one of {', '.join(_PARITIES)}, got {parity!r}"
        )
        stop = parsed.whole_option("stop", 1, 2)
        self.place = replace(place, parity=_PARITIES[parity], stop=stop)
        self.number = parsed.whole(unit, "unit", ADDRESS_MAX) if unit else ADDRESS
        self.line = self.place.name
        self.boot_time = BOOT_TIME if self._is_rtu else 0.0
        self.settings = {
            "protocol": "Modbus RTU" if self._is_rtu else "Modbus TCP",
            "baud": self.place.baud,
            "parity": self.place.parity,
            "stop": self.place.stop,
        }

    def make_wire(self) -> ModbusWire:
        """Make the wire; a random start, so that a reply to an earlier host does not match."""
        delay = 0.0 if self.place.device else NETWORK_DELAY
        number = random.getrandbits(16)
        return ModbusWire(self.place.baud, is_rtu=self._is_rtu, number=number, delay=delay)

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the port; raises LinkError."""
        if not self.place.device:
            return await open_port(self.place, on_data, on_loss)
        port = SilentPort(self.make_wire().silence, self.place.byte_time, on_data)
        port.below = await open_port(self.place, port.received, on_loss)
        return port
