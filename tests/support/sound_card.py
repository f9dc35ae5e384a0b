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
import pytest

from drivers.errors import LinkError
from model.arrays import Float32Array
from preloaded import ERA
from sim.libjack import JackClient
from sim.measuring.jack_card import activate
from sim.measuring.sound_card import SoundCard

RATE = 48_000
BLOCK = 128
START = 20.0  # s
LONGEST = 600  # s that a client captures
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


class Capture(SoundCard):
    """A client of so many inputs; a callback in C keeps all samples, and when blocks came."""

    def __init__(self, name: str, channels: int, *, server: str) -> None:
        super().__init__(outputs=0, inputs=channels, limit=0)
        self._client = _client(name, server)
        activate(self, self._client, outputs=0, inputs=channels)
        self._arrivals = self.note_arrivals(LONGEST * RATE // BLOCK)
        self._samples = self.begin(np.zeros((LONGEST * RATE, 0)))

    def samples(self, count: int) -> Float32Array:
        """The last samples (count, channels)."""
        return self._samples[self.position - count : self.position]

    def is_sounding(self) -> bool:
        """Whether the last block had sound."""
        return self.position > 0 and bool(np.abs(self.samples(BLOCK)).max() > AUDIBLE)

    def last_sound(self) -> float:
        """When the last block with sound came (monotonic, s)."""
        loud = np.abs(self._samples[: self.position]).max(axis=1) > AUDIBLE
        return 1e-6 * float(self._arrivals[np.flatnonzero(loud)[-1] // BLOCK])

    def close(self) -> None:
        """Leave the server."""
        self._client.close()


def _client(name: str, server: str) -> JackClient:
    """A client, as soon as the server is up."""
    end = time.monotonic() + START
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JACK_DEFAULT_SERVER", server)
        while True:
            try:
                return JackClient(name)
            except LinkError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.02)


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
