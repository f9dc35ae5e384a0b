"""The smallest amplifier in C, which shares no table with the host, played by the host."""

import asyncio
import ctypes
import os
import pty
import shutil
import subprocess
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

import era_haptics
from drivers.conformance import CheckResult, of_kind
from drivers.conformance.check import run_checks
from drivers.conformance.serial_frames import SerialClient
from drivers.contents import Tone
from drivers.host.amplifier import Amplifier
from drivers.host.group import Group
from drivers.opening import Lines
from registry.limits import GuardLimits
from virtual_loop import run_virtual

SOURCE = Path(era_haptics.__file__).parents[1] / "examples" / "smallest_amplifier" / "amplifier.c"
LIMITS = GuardLimits(20.0, 900.0, 1.0)
BUILD = "-std=c11 -D_GNU_SOURCE -Wall -Wextra -Werror -O1 -fsanitize=address,undefined"

pytestmark = pytest.mark.real_time


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program, under sanitizers."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.fail("a C compiler must be installed")
    built = tmp_path_factory.mktemp("smallest") / "amplifier"
    command = [compiler, *BUILD.split(), "-o", str(built), str(SOURCE), "-lm"]
    subprocess.run(command, check=True)
    return built


async def played(program: Path, test: Callable[[Group, Amplifier], Awaitable[None]]) -> None:
    """Run a test with the armed program on a pseudo-terminal; it must report no error."""
    far, near = pty.openpty()
    running = subprocess.Popen([program], stdin=far, stderr=subprocess.PIPE)  # noqa: ASYNC220
    lines = Lines()
    try:
        host = await lines.amplifier(f"serial://{os.ttyname(near)}", LIMITS, name="smallest")
        group = Group({"smallest": host}, watchdog=2.0)
        await group.open()
        await group.arm()
        await test(group, host)
        await group.stop()
    finally:
        await lines.close()
        running.terminate()
        _, errors = running.communicate()
        os.close(near)
        os.close(far)
    assert errors == b""


MOVED = Path(__file__).parents[1] / "support" / "moved_smallest.c"
SKIPPED = {
    *("sensors", "steps_as_stated", "limited", "measured", "readings", "addresses"),
    "phases",  # its levels are sums of magnitudes, which is allowed
}


class MovedLine:
    """The program as a library, on the clock of the virtual loop; a `Port` of its client."""

    def __init__(self, library: Path) -> None:
        self._library = ctypes.CDLL(str(library))
        self._library.receive.argtypes = [ctypes.c_char_p, ctypes.c_int, ctypes.c_double]
        self._sent = ctypes.create_string_buffer(1 << 16)
        self._loop = asyncio.get_running_loop()
        self.client = SerialClient(1)
        self.client.port = self
        self._library.begin()
        self._turning = self._loop.create_task(self._turn())

    def write(self, data: bytes) -> None:
        """Send bytes to the program."""
        self._loop.call_later(0.0002, self._receive, data)

    def close(self) -> None:
        """Stop its clock."""
        self._turning.cancel()

    def _receive(self, data: bytes) -> None:
        self._library.receive(data, len(data), self._loop.time())
        count = self._library.sent_since(self._sent)
        if count:
            self._loop.call_later(0.0002, self.client.received, self._sent.raw[:count])

    async def _turn(self) -> None:
        while True:
            self._receive(b"")
            await asyncio.sleep(0.001)


@pytest.mark.parametrize("level", [0.2, 0.9])
def test_conformance_on_a_clock_that_is_moved(level: float, tmp_path: Path) -> None:
    """All checks pass, where time is that of the test, and its sums of layers are limited."""
    library = tmp_path / "moved.so"
    include = f"-I{SOURCE.parent}"
    options = [
        "-std=c11",
        "-D_GNU_SOURCE",
        "-Wall",
        "-Wextra",
        "-Werror",
        "-O1",
        "-shared",
        "-fPIC",
    ]
    compiler = shutil.which("cc")
    assert compiler is not None
    command = [compiler, *options, include, "-o", str(library), str(MOVED), "-lm"]
    subprocess.run(command, check=True)

    async def results() -> list[CheckResult]:
        line = MovedLine(library)
        try:
            return [*await run_checks(of_kind("serial"), line.client, level=level)]
        finally:
            line.close()

    found = run_virtual(results())
    failed = [f"{each.check.name}: {each.reason}" for each in found if each.result == "failed"]
    assert not failed, failed[0]
    skipped = {each.check.name for each in found if each.result == "skipped"}
    assert skipped == (SKIPPED if level < 0.5 else SKIPPED - {"limited"})


def tone(channel: int, level: float, frequency: float = 100.0, **other: object) -> Tone:
    """A tone."""
    return Tone(channel, frequency, level, **other)  # type: ignore[arg-type]


def test_source_is_small() -> None:
    """At most 500 lines of at most 100 characters."""
    lines = SOURCE.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 500
    assert max(map(len, lines)) <= 100
