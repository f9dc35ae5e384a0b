"""Transport of a Modbus line: a TCP connection or a serial port."""

from collections.abc import Callable

from drivers.hardware import Port
from drivers.ports.opening import open_port
from drivers.ports.tcp import open_connection
from drivers.urls.modbus import ModbusUrl


async def open_stream(
    line: ModbusUrl, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
) -> Port:
    """Open a line; LinkError with a remedy."""
    if not line.device:
        return await open_connection(line.host, line.port, on_data, on_loss)
    return await open_port(
        line.device,
        baud=line.baud,
        parity=line.parity,
        stop=line.stop,
        on_data=on_data,
        on_loss=on_loss,
    )
