"""Amplifiers on real wires: pseudo-terminals, and a TCP port of Modbus."""

from collections.abc import Sequence
from functools import partial

from drivers.urls import ADDRESS, BAUD, RTU_BAUD
from sim.bench.amplifier_device import AmplifierDevice
from sim.far_ends.modbus_amplifiers import ModbusAmplifiers
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.far_end import TcpEnd, TerminalEnd
from sim.transport.loopback import HOST

_SERIAL_BITS, _MODBUS_BITS = 10, 11  # of a byte: start, eight data, parity on Modbus, stop


class SerialLineEnd(TerminalEnd):
    """A pseudo-terminal with devices at the addresses of their numbers, one alone at the first.

    baud: None for no transmission time; unpluggable: see `make_terminal`.
    """

    def __init__(
        self,
        devices: Sequence[AmplifierDevice],
        *,
        baud: int | None = None,
        unpluggable: bool = False,
    ) -> None:
        is_alone = len(devices) == 1
        by_address = {ADDRESS if is_alone else each.address: each for each in devices}
        super().__init__(
            devices,
            partial(SerialAmplifiers, by_address),
            bits_per_second=baud,
            bits_per_byte=_SERIAL_BITS,
            unpluggable=unpluggable,
        )
        self._addresses = {each.name: address for address, each in by_address.items()}
        self._baud = baud or BAUD

    @property
    def urls(self) -> dict[str, str]:
        """The URL of each amplifier, by its name."""
        return {
            name: f"serial://{self.port}?baud={self._baud}"
            + ("" if address == ADDRESS else f"&address={address}")
            for name, address in self._addresses.items()
        }


class ModbusLineEnd(TerminalEnd):
    """A pseudo-terminal with devices at the units of their numbers, in Modbus RTU.

    speed [bit/s]: None for no transmission time; unpluggable: see `make_terminal`.
    """

    def __init__(
        self,
        devices: Sequence[AmplifierDevice],
        *,
        speed: int | None = None,
        unpluggable: bool = False,
    ) -> None:
        units = {each.address: each for each in devices}
        super().__init__(
            devices,
            lambda send: ModbusAmplifiers(units, send, is_rtu=True),
            bits_per_second=speed,
            bits_per_byte=_MODBUS_BITS,
            unpluggable=unpluggable,
        )
        self._names = {each.name: each.address for each in devices}
        self._baud = speed or RTU_BAUD

    @property
    def urls(self) -> dict[str, str]:
        """The URL of each amplifier, by its name."""
        line = f"modbus+rtu://{self.port}?baud={self._baud}"
        return {name: f"{line}#{unit}" for name, unit in self._names.items()}


class ModbusPortEnd(TcpEnd):
    """A TCP port with devices at the units of their numbers, 0 for any port."""

    def __init__(self, devices: Sequence[AmplifierDevice], *, port: int = 0) -> None:
        units = {each.address: each for each in devices}
        registers = ModbusAmplifiers(units, lambda data: None, is_rtu=False)
        super().__init__(devices, registers.of_connection, port=port)
        self._names = {each.name: each.address for each in devices}

    @property
    def urls(self) -> dict[str, str]:
        """The URL of each amplifier by name, after `start`."""
        return {
            name: f"modbus+tcp://{HOST}:{self.port}/{unit}" for name, unit in self._names.items()
        }
