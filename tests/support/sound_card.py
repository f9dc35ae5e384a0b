"""A sound card without sound: a JACK server, and a client that captures what is played to it."""

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.desk.capture import Capture
from installed_program import ERA

RATE = 48_000
BLOCK = 128
START = 20.0  # s
HOST = str(Path(__file__).with_name("steady_host.py"))


@dataclass(frozen=True)
class JackServer:
    """A running server; environment: of its clients."""

    process: "subprocess.Popen[bytes]"
    environment: dict[str, str]


@contextlib.contextmanager
def jack_server(
    name: str, *, rate: int = RATE, inputs: int = 2, outputs: int = 2
) -> Iterator[JackServer]:
    """A server of its own; synchronous: a machine that stalls delays samples and loses none."""
    environment = os.environ | {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}
    priority = ["-R", "-P10"] if os.geteuid() == 0 else ["-r"]
    dummy = ["-d", "dummy", "-p", str(BLOCK), "-r", str(rate)]
    dummy += ["-C", str(inputs), "-P", str(outputs)]
    with subprocess.Popen(
        ["jackd", "-n", name, "-S", *priority, *dummy],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
    ) as process:
        try:
            yield JackServer(process, environment)
        finally:
            process.terminate()


def capture_on(server: str, name: str, channels: int) -> Capture:
    """A client of a server that captures, as soon as that is up."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JACK_DEFAULT_SERVER", server)
        return Capture(name, channels)


class SoftAmp:
    """A running `era soft-amp`; url: of its first amplifier."""

    def __init__(self, *options: str, environment: dict[str, str], log: Path) -> None:
        self._log = log
        with log.open("wb") as errors:
            self.process = subprocess.Popen(
                [ERA, "soft-amp", *options, "--until-eof"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
            )
        assert self.process.stdout is not None
        self.url = self.process.stdout.readline().strip()

    @property
    def log(self) -> str:
        """What it has reported."""
        return self._log.read_text()

    @property
    def player(self) -> int:
        """The process that plays."""
        path = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return int(path.read_text().split()[0])

    def end(self) -> None:
        """End it as the end of its input does."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(START)
        self.process.stdout.close()


@contextlib.contextmanager
def host(url: str, channels: int) -> Iterator["subprocess.Popen[str]"]:
    """A program that plays 1 kHz at level 0.5 on every channel, each 30 degrees ahead."""
    with subprocess.Popen(
        [sys.executable, HOST, url, str(channels)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "armed\n"
        yield process
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGKILL)
