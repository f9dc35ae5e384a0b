"""CAN through python-can: can+socketcan://can0#NODE, can+python-can://INTERFACE/CHANNEL#NODE."""

from collections.abc import Callable

from drivers.hardware import Port
from drivers.wires.can_address import CanAddress


class PythonCanAddress(CanAddress):
    """A node on a bus of one of python-can's interfaces."""

    async def open_port(
        self, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> Port:
        """Open the bus; raises LinkError."""
        from drivers.wires.bus_port import open_bus  # python-can takes a tenth of a second

        return await open_bus(self.bus, on_data, on_loss)
