"""The smallest amplifier in C, which shares no table with the host, under conformance."""

import asyncio
import ctypes
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

import era_haptics
from drivers.by_hand.actions import identify
from installed_program import installed_program
from judged_line import judged

SOURCE = Path(era_haptics.__file__).parents[1] / "examples" / "smallest_amplifier" / "amplifier.c"
MOVED = Path(__file__).parents[1] / "support" / "moved_smallest.c"
BUILD = "-std=c11 -D_GNU_SOURCE -Wall -Wextra -Werror -O1 -fsanitize=undefined -shared -fPIC"
SKIPPED = {
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
        if count := self._library.sent_since(self._sent):
            self._send(self._sent.raw[:count])

    def tick(self, now: float) -> None:
        """Let happen what is due by itself."""
        self.receive(b"", now)


@pytest.mark.parametrize("level", [0.2, 0.9])
def test_conformance_on_a_clock_that_is_moved(level: float, tmp_path: Path) -> None:
    """All checks pass, where time is that of the test, and its sums of layers are limited."""
    library = tmp_path / "moved.so"
    compiler = installed_program("cc", package="gcc")
    command = [compiler, *BUILD.split(), f"-I{SOURCE.parent}", "-o", library, MOVED, "-lm"]
    subprocess.run(command, check=True)
    found = judged("serial", level=level, far=partial(SmallestEnd, library))
    failed = [f"{each.check.name}: {each.reason}" for each in found if each.result == "failed"]
    assert not failed, failed[0]
    skipped = {each.check.name for each in found if each.result == "skipped"}
    assert skipped == (SKIPPED if level < 0.5 else SKIPPED - {"limited"})


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
        assert running.stdout is not None
        url = running.stdout.readline().strip()
        assert asyncio.run(identify(url))["serial_number"] == "SMALLEST-1"
        running.kill()


def test_source_is_small() -> None:
    """At most 500 lines of at most 100 characters."""
    lines = SOURCE.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 500
    assert max(map(len, lines)) <= 100
