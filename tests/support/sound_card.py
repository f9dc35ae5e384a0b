"""A sound card without sound: a JACK server, and a client that captures what is played to it."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from model.arrays import FloatArray
from preloaded import ERA

RATE = 48_000
BLOCK = 128
START = 20.0  # s
AUDIBLE = 1e-6
HOST = str(Path(__file__).with_name("steady_host.py"))


@contextlib.contextmanager
def jack_server(name: str) -> Iterator[dict[str, str]]:
    """A server of its own; yields the environment of its clients."""
    environment = os.environ | {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}
    priority = ["-R", "-P10"] if os.geteuid() == 0 else ["-r"]
    dummy = ["-d", "dummy", "-p", str(BLOCK), "-r", str(RATE), "-C", "2", "-P", "2"]
    with subprocess.Popen(
        ["jackd", "-n", name, *priority, *dummy],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
    ) as process:
        yield environment
        process.terminate()


class Capture:
    """A client of so many inputs; keeps every block with its arrival (monotonic, s)."""

    def __init__(self, name: str, channels: int, *, server: str) -> None:
        import jack  # needs libjack

        jack.set_error_function(lambda _text: None)
        jack.set_info_function(lambda _text: None)
        end = time.monotonic() + START
        while True:
            try:
                self._client = jack.Client(name, servername=server, no_start_server=True)
                break
            except jack.JackOpenError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.02)  # until the server is up
        self._ports = [self._client.inports.register(f"in_{n}") for n in range(channels)]
        self._blocks: list[tuple[float, FloatArray]] = []
        self._client.set_process_callback(self._take)
        self._client.activate()

    def _take(self, frames: int) -> None:
        samples = np.stack([port.get_array() for port in self._ports], axis=1)
        self._blocks.append((time.monotonic(), samples.copy()))

    def samples(self, count: int) -> FloatArray:
        """The last samples (count, channels)."""
        blocks = self._blocks[-(count // BLOCK + 2) :]
        return np.concatenate([block for _, block in blocks])[-count:]

    def is_sounding(self) -> bool:
        """Whether the last block had sound."""
        return bool(self._blocks) and bool(np.abs(self._blocks[-1][1]).max() > AUDIBLE)

    def last_sound(self) -> float:
        """When the last block with sound came."""
        return next(when for when, block in self._blocks[::-1] if np.abs(block).max() > AUDIBLE)

    def close(self) -> None:
        """Leave the server."""
        self._client.deactivate()
        self._client.close()


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


def until(is_true: Any, *, timeout: float = START) -> None:
    """Wait for a condition; AssertionError if it never holds."""
    end = time.monotonic() + timeout
    while not is_true():
        assert time.monotonic() < end
        time.sleep(0.01)


def conformance(url: str) -> dict[str, Any]:
    """The report of the reading checks."""
    done = subprocess.run(
        [ERA, "amp", "conformance", url, "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    report: dict[str, Any] = json.loads(done.stdout)
    return report
