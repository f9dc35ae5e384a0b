"""Blocks that PortAudio reports lost, at the callback in C."""

import ctypes

import numpy as np
import pytest

from sim.measuring.sound_card import SoundCard

FRAMES = 64
# paInputUnderflow, paInputOverflow, paOutputUnderflow, paOutputOverflow of portaudio.h
LOST = (0x1, 0x2, 0x4, 0x8)
PRIMING = 0x10  # paPrimingOutput: nothing is lost


class CallbackCard(SoundCard):
    """Calls the callback as PortAudio does, with a number of flags for each block."""

    def __init__(self, flags: list[int]) -> None:
        super().__init__(outputs=1, inputs=1, limit=1.0)
        self._flags = flags

    def start(self, blocks: int) -> np.ndarray:
        """Let blocks of zeros be played; returns the memory that is recorded to."""
        return self.begin(np.zeros((blocks * FRAMES, 1)))

    def call(self) -> int:
        """All blocks; returns the gaps that were counted."""
        kind = ctypes.CFUNCTYPE(
            ctypes.c_int,
            ctypes.c_void_p,
            ctypes.c_void_p,
            ctypes.c_ulong,
            ctypes.c_void_p,
            ctypes.c_ulong,
            ctypes.c_void_p,
        )
        callback = kind(self.address("transfer_portaudio"))
        block = np.ones(FRAMES, dtype=np.float32)
        out = np.zeros(FRAMES, dtype=np.float32)
        recorded, played, given = block.ctypes.data, out.ctypes.data, self.given()
        for flags in self._flags:
            assert callback(recorded, played, FRAMES, None, flags, given) == 0
        return self._transfer.gaps

    def close(self) -> None:
        """Nothing is open."""


@pytest.mark.parametrize(
    ("flags", "gaps"),
    [
        *(([0, flag, 0], 1) for flag in LOST),
        ([0, LOST[0] | LOST[2], LOST[1]], 2),
        ([0, PRIMING, 0], 0),
        ([LOST[1], 0, 0], 0),  # before the first frame
        ([0, 0, 0, LOST[1]], 0),  # after the last one
    ],
)
def test_lost_blocks_are_gaps_while_something_plays(flags: list[int], gaps: int) -> None:
    """Each block with a flag of a loss, from the second to the last, is one gap."""
    card = CallbackCard(flags)
    heard = card.start(3)
    assert card.call() == gaps
    assert heard.all()


@pytest.mark.parametrize("sample", [1.01, np.nan])
def test_samples_beyond_the_limit_are_not_played(sample: float) -> None:
    """The last check before a device; a sample that is no number would pass for none."""
    card = CallbackCard([])
    with pytest.raises(ValueError, match="at most 1"):
        card.run(np.full((FRAMES, 1), sample))
