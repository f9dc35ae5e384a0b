"""Amplifiers of protocol 3 on a CAN bus: bytes by hand, a foreign reader, and damage.

Frames are written as identifier and data in hexadecimal digits.
"""

from collections.abc import Iterator

import canopen
import pytest
from canopen.sdo.client import SdoClient

from drivers.codec.can_bus.canopen import CanFrame
from drivers.codec.can_bus.segments import pack_frames, unpack_frames
from sim.amplifier.contract import Amplifier
from sim.far_ends.can_bus.amplifiers import CanAmplifiers

START = (0x000, "0100")
ARM = (0x201, "010003023412fa00")  # session 1234, 250 ms
SET = (  # session 1234, token 7: layer 0 along 0 ms, channel 0 at 100 Hz and half level
    (0x201, "0200050a34120700"),
    (0x201, "0201020001000000"),
    (0x201, "020200000000d007"),
    (0x201, "0203881300000000"),
)
COMMIT = (0x200, "0000060234120700")


class Bus:
    """Amplifiers of one channel from node 1 on, and the frames that they have sent."""

    def __init__(self, *names: str) -> None:
        self.far = [Amplifier(name, channels=1) for name in names]
        self.sent: list[tuple[int, str]] = []
        self.end = CanAmplifiers(dict(enumerate(self.far, 1)), self._note)
        self.end.start(0.0)

    def _note(self, data: bytes) -> None:
        self.sent.extend((frame.id, frame.data.hex()) for frame in unpack_frames(data))

    def put(self, now: float, *frames: tuple[int, str]) -> list[tuple[int, str]]:
        """Send frames at a time [s]; returns what comes back at once."""
        self.sent.clear()
        self.end.receive(pack_frames(CanFrame(i, bytes.fromhex(data)) for i, data in frames), now)
        return [*self.sent]

    def level(self, at: float, of: int = 0) -> float:
        """What an amplifier plays."""
        self.end.tick(at)
        return self.far[of].playback.level(0, at)


@pytest.fixture
def bus() -> Bus:
    """One amplifier, operational."""
    bus = Bus("a")
    bus.put(0.0, START)
    return bus


@pytest.mark.parametrize("lost", range(4))
def test_set_without_one_of_its_frames_is_not_played(bus: Bus, lost: int) -> None:
    """No reply, nothing to commit; the repetition under a newer number is."""
    bus.put(0.0, ARM)
    kept = [*SET[:lost], *SET[lost + 1 :]]
    assert bus.put(0.1, *kept, COMMIT) == []
    assert bus.level(0.1) == 0.0
    bus.put(0.11, *((can_id, f"03{data[2:]}") for can_id, data in SET), COMMIT)
    assert bus.level(0.11) == 0.5


class Reader(canopen.Network):
    """The package `canopen` on the bus, without threads."""

    def __init__(self, bus: Bus) -> None:
        super().__init__()
        self._bus = bus

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        """Put a frame on the bus, and hand over what comes back."""
        for answer, reply in self._bus.put(0.0, (can_id, bytes(data).hex())):
            self.notify(answer, bytearray.fromhex(reply), 0.0)


@pytest.fixture
def read(bus: Bus) -> Iterator[SdoClient]:
    """Its client of the objects of node 1."""
    node = canopen.RemoteNode(1, canopen.ObjectDictionary())
    node.associate_network(Reader(bus))
    yield node.sdo
    node.remove_network()


def test_identity_is_read_by_a_foreign_master(read: SdoClient) -> None:
    """1018: vendor 0, product 1, revision 1, crc32 of SIM-a; 2000: texts, and version 3 alone."""
    numbers = [int.from_bytes(read.upload(0x1018, each), "little") for each in range(5)]
    assert numbers == [4, 0, 1, 1, 0x3D504003]
    texts = [read.upload(0x2000, each) for each in range(1, 5)]
    assert texts == [b"era-haptics", b"simulated amplifier", b"SIM-a", b"1"]
    assert [read.upload(0x2000, each) for each in (0, 5)] == [b"\x05", b"\x08\x00"]
