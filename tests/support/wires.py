"""Every wire with its far end, for tests that hold on all of them: one entry a wire."""

from collections.abc import Mapping
from dataclasses import replace

from model.rig.rig import Channel, Rig
from sim.far_ends.wires import Wire

WIRES: Mapping[str, Wire] = {
    "serial": Wire("serial", unpluggable=True),
    "modbus+tcp": Wire("modbus-tcp", unpluggable=True),
    "modbus+rtu": Wire("modbus-rtu", unpluggable=True),
    "can+socketcand": Wire("socketcand", unpluggable=True),
    "can+slcan": Wire("slcan", unpluggable=True),
}
"""Each is far end and host by one scheme; see `sim.far_ends.wires`."""

SHARED_WIRES: Mapping[str, Wire] = {
    "serial": Wire("serial", shared=True),
    "modbus+tcp": Wire("modbus-tcp", shared=True),
    "modbus+rtu": Wire("modbus-rtu", shared=True),
    "can+socketcand": Wire("socketcand", shared=True),
    "can+slcan": Wire("slcan", shared=True),
}
"""Those on which several amplifiers hear one broadcast."""


def on_two_amplifiers(rig: Rig) -> Rig:
    """Wire the ERAs of a rig to two amplifiers, east and west, in turn."""
    wiring = {
        era: Channel("west" if number % 2 else "east", number // 2)
        for number, era in enumerate(rig.wiring)
    }
    return replace(rig, wiring=wiring, amplifiers={"east": "sim://", "west": "sim://"})
