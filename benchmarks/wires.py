"""`python -m benchmarks.wires`: functions of the host that one set enters, and their files.

A set of four channels on one amplifier, and on four at a line each, 20 ms after the one before,
over simulated amplifiers in this process. What these and the event loop do does not count.
"""

import asyncio
import sys
from collections import Counter
from types import FrameType

from drivers.host.amplifier import Amplifier as Host
from drivers.host.group import Group
from drivers.host.line import Line
from drivers.playing import AmplifierLayer, AmplifierTone
from drivers.wires.serial_line import SerialWire
from registry import threads
from registry.limits import GuardLimits
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

CHANNELS = 4
_PAUSE = 0.02  # s; between two sets


class _Port:
    """A port with one simulated amplifier at its other end."""

    is_blocked = False

    def __init__(self, name: str) -> None:
        self.line = Line(SerialWire(921_600, sequence=0), name)
        self.line.open(self)
        amplifier = SimulatedAmplifier(name, channels=CHANNELS)
        self._end = SerialAmplifiers({1: amplifier}, self._reply)

    def write(self, data: bytes) -> None:
        asyncio.get_running_loop().call_soon(self.carry_out, data)

    def carry_out(self, data: bytes) -> None:
        """Have the amplifier take bytes: nothing in here is the host's."""
        self._end.receive(data, threads.now())

    def poll(self) -> None:
        """All that has come was handed over."""

    def _reply(self, data: bytes) -> None:
        asyncio.get_running_loop().call_soon(self.line.received, data)


async def calls_of_a_set(amplifiers: int) -> Counter[str]:
    """Return how many functions one set enters, by file, for so many amplifiers."""
    ports = {f"amplifier {n}": _Port(f"amplifier {n}") for n in range(amplifiers)}
    limits = GuardLimits(20.0, 1000.0, 1.0)
    group = Group({name: Host(port.line, 1, limits, name=name) for name, port in ports.items()})
    await group.open()
    await group.arm()
    entered: Counter[str] = Counter()
    beyond = 0

    def note(frame: FrameType, event: str, argument: object) -> None:
        nonlocal beyond
        code = frame.f_code
        if code is _Port.carry_out.__code__:
            beyond += {"call": 1, "return": -1}.get(event, 0)
        elif event == "call" and not beyond and "/drivers/" in code.co_filename:
            entered[code.co_filename.rpartition("/drivers/")[2]] += 1

    for frequency in (100.0, 120.0):
        tones = tuple(AmplifierTone(channel, frequency, 0.3) for channel in range(CHANNELS))
        await asyncio.sleep(_PAUSE)
        sys.setprofile(note)
        entered.clear()
        await group.apply({name: [AmplifierLayer(0, tones, 0.005)] for name in ports})
        sys.setprofile(None)
    await group.disarm(0.0)
    return entered


def main() -> None:
    """Print the figures."""
    for amplifiers in (1, 4):
        entered = asyncio.run(calls_of_a_set(amplifiers))
        files = ", ".join(f"{name} {count}" for name, count in entered.most_common())
        print(f"{amplifiers} amplifiers: {entered.total()} calls in {len(entered)} files: {files}")


if __name__ == "__main__":
    main()
