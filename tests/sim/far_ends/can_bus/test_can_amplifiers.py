"""Amplifiers of protocol 4 on a CAN bus: bytes by hand, of which some are lost.

Frames are written as identifier and data in hexadecimal digits.
"""

import pytest

from drivers.wires.can_frames import CanFrame, pack_frames, unpack_frames
from sim.amplifier.simulated_amplifier import Amplifier
from sim.far_ends.can_amplifiers import CanAmplifiers

START = (0x000, "0100")
ARM = ((0x201, "010003033412fa00"), (0x201, "0101000000000000"))  # session 1234, 250 ms
SET = (  # session 1234, token 7: layer 0 along 0 ms, channel 0 at 100 Hz and half level
    (0x201, "0200050a34120700"),
    (0x201, "0201020001000000"),
    (0x201, "020200000000d007"),
    (0x201, "0203881300000000"),
)
COMMIT = ((0x200, "0000060334120700"), (0x200, "0001000000000000"))


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
    bus.put(0.0, *ARM)
    kept = [*SET[:lost], *SET[lost + 1 :]]
    assert bus.put(0.1, *kept, *COMMIT) == []
    assert bus.level(0.1) == 0.0
    bus.put(0.11, *((can_id, f"03{data[2:]}") for can_id, data in SET), *COMMIT)
    assert bus.level(0.11) == 0.5
