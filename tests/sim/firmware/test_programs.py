"""Programs of the firmware as amplifiers, and the frequencies of their samples."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from model.errors import InputError
from sim import firmware
from sim.firmware import ending_with_parent, frequencies_in

RATE = 16_000.0


@pytest.mark.parametrize("frequency", [40.0, 128.45, 270.0, 499.95])
def test_frequency_of_a_steady_tone_is_found_to_the_step_of_the_wire(frequency: float) -> None:
    """In a quarter of a second, on channels of other levels and phases; silent ones have none."""
    t = np.arange(4000) / RATE
    tones = [0.9 * np.sin(2 * np.pi * frequency * t), 0.01 * np.cos(2 * np.pi * frequency * t)]
    samples = np.column_stack([*tones, np.zeros((len(t), 2))])
    assert frequencies_in(samples, rate=RATE) == pytest.approx([frequency], abs=0.051)


def test_frequencies_of_channels_and_of_a_cross_fade_are_told_apart() -> None:
    """Two channels with a tone each, one of which changes to another."""
    t = np.arange(4000) / RATE
    changing = np.where(t < 0.12, np.sin(2 * np.pi * 100 * t), 0.5 * np.sin(2 * np.pi * 180 * t))
    samples = np.column_stack([changing, np.sin(2 * np.pi * 130 * t)])
    assert frequencies_in(samples, rate=RATE) == pytest.approx([100, 130, 180], abs=0.5)


def test_missing_firmware_is_told_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a checkout the command that builds it, elsewhere that a checkout is needed."""
    monkeypatch.setattr(firmware, "FOLDER", tmp_path / "out" / "firmware")
    with pytest.raises(InputError, match="checkout"):
        firmware.find_firmware()
    (tmp_path / "firmware").mkdir()
    with pytest.raises(InputError, match="make firmware"):
        firmware.find_firmware()


PARENT = """
import subprocess, sys, time
from sim.firmware import ending_with_parent
child = [sys.executable, "-c", "import time; print('here', flush=True); time.sleep(60)"]
subprocess.Popen(ending_with_parent(child))
time.sleep(60)
"""


def test_child_ends_when_its_parent_is_killed() -> None:
    """Its output is at its end then, although nobody has told it."""
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"here\n"
        parent.send_signal(signal.SIGKILL)
        assert parent.stdout.read() == b""


def test_child_whose_parent_is_gone_does_not_start() -> None:
    """As if the parent had been killed before the child could ask to be told."""
    command = ending_with_parent([sys.executable, "-c", "print('here')"])
    command[3] = str(os.getpid() + 1)
    done = subprocess.run(command, capture_output=True, check=False)
    assert done.stdout == b""
