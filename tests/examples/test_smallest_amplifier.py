"""The smallest amplifier in C, which shares no table with the host, under conformance."""

import asyncio
import ctypes
import math
import shutil
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from drivers.by_hand.actions import identify_amplifier
from drivers.wires.serial_frames import Frame, encode_frame
from kit.judged_lines import judged
from processes.installed import installed_program

ROOT = Path(__file__).parents[2]


SOURCE = ROOT / "examples" / "smallest_amplifier" / "amplifier.c"
BUILD = "-std=c11 -D_GNU_SOURCE -Wall -Wextra -Werror -O1 -fsanitize=undefined -shared -fPIC"
NOT_IN_SMALLEST = {
    *("sensors", "steps_as_stated", "limited", "measured", "readings", "addresses", "mark"),
}


class SmallestEnd:
    """The program as a library, the far end of a serial line."""

    def __init__(self, library: Path, send: Callable[[bytes], None]) -> None:
        self._library, self._send = ctypes.CDLL(str(library)), send
        self._library.receive.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_double]
        self._sent = ctypes.create_string_buffer(1 << 16)
        self._library.begin()

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        self._library.receive(data, len(data), now)
        count = self._library.sent_since(self._sent)
        if count:
            self._send(self._sent.raw[:count])

    def tick(self, now: float) -> None:
        """Let happen what is due by itself."""
        self.receive(b"", now)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program as a library whose time is that of its caller."""
    library = tmp_path_factory.mktemp("smallest") / "moved.so"
    compiler = installed_program("cc", package="gcc")
    command = [compiler, *BUILD.split(), f"-I{SOURCE.parent}", "-o", library]
    command += [ROOT / "tests" / "programs" / "moved_smallest.c", "-lm"]
    subprocess.run(command, check=True)
    return library


@pytest.fixture
def library(tmp_path: Path, compiled: Path) -> Path:
    """A copy of it, which has variables of its own."""
    return shutil.copy(compiled, tmp_path / "moved.so")


SOME_CHECKS = (
    "every_channel",
    "ramps",
    "stop",
    "watchdog",
    "achieved",
    "voices",
    "kept_phase",
    "phases",
)


@pytest.mark.parametrize(
    ("level", "names"),
    [
        (0.2, SOME_CHECKS),
        *(pytest.param(result, (), marks=pytest.mark.long) for result in (0.2, 0.9)),
    ],
)
def test_conformance_on_a_clock_that_is_moved(
    level: float, names: tuple[str, ...], library: Path
) -> None:
    """All checks pass, where time is that of the test, and its sums of layers are limited."""
    results = judged("serial", names, level=level, far=partial(SmallestEnd, library))
    failed = [
        f"{result.check.name}: {result.reason}" for result in results if result.result == "failed"
    ]
    assert not failed, failed[0]
    skipped = {result.check.name for result in results if result.result == "skipped"}
    lacking = NOT_IN_SMALLEST if level < 0.5 else NOT_IN_SMALLEST - {"limited"}
    assert skipped == lacking & {result.check.name for result in results}


@pytest.mark.parametrize(
    ("frequency", "clock", "angle"),
    [(2200, 0x0010_0000, 193.359375), (2200, 0xF000_0000, 180), (5010, 0x1234_5678, 96)],
)
def test_samples_have_the_angles_of_the_page(
    frequency: int, clock: int, angle: float, library: Path
) -> None:
    """A tone of level 0.8 at 30° plays 0.8 · sin(angle + 30°), by a clock shifted and steered."""
    far = SmallestEnd(library, lambda _: None)
    ahead, rate = 1000, 10_000  # steps of shift that the clock has yet to run, 1000 ppm faster
    tone = (1, 0, 0, 0, frequency, 8000, 3000)  # layer 0 with one command, along a ramp of 0
    shift = ((clock >> 16) - ahead) % 65536
    for kind, words in ((3, (7, 2000, shift)), (12, (7, rate)), (5, (7, 1, 1 << 1 | 1, *tone))):
        far.receive(encode_frame(Frame(kind, 1, kind, b"", 4), words), 0)
    sample_of = ctypes.CDLL(str(library)).sample_of
    sample_of.argtypes, sample_of.restype = [ctypes.c_int, ctypes.c_double], ctypes.c_double
    time = ((ahead << 16) + clock % 65536) * 20 / 2**32 / (1 + rate * 1e-7)
    expected = 0.8 * math.sin(math.radians(angle + 30))
    assert sample_of(0, time) == pytest.approx(expected, abs=2e-5)


@pytest.mark.real_time
def test_program_serves_a_pseudo_terminal_and_leaves_the_users_alone(tmp_path: Path) -> None:
    """Its URL is printed, and a host finds it there; without an argument it says what it takes."""
    program = tmp_path / "amplifier"
    build = [installed_program("cc", package="gcc"), "-o", program, SOURCE, "-lm"]
    subprocess.run(build, check=True)
    bare = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (bare.returncode, bare.stdout) == (2, "")
    assert bare.stderr == "usage: amplifier TTY | --pty\n"
    with subprocess.Popen([program, "--pty"], stdout=subprocess.PIPE, text=True) as running:
        url = running.stdout.readline().strip()
        assert asyncio.run(identify_amplifier(url))["serial_number"] == "SMALLEST-1"
        running.kill()
