"""Sound servers without a sound card, and the software amplifier on them, as processes."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from processes.installed import ERA

RATE = 48_000
BLOCK = 256
START = 20.0  # s
JACK_PRIORITY = ("-R", "-P10") if os.geteuid() == 0 else ("-r",)
"""Options of jackd: real-time priority, which root may have, else the ordinary one."""


@dataclass(frozen=True)
class JackServer:
    """A running server; environment: of its clients."""

    process: "subprocess.Popen[bytes]"
    environment: dict[str, str]


@contextlib.contextmanager
def jack_server(
    name: str, *, rate: int = RATE, inputs: int = 2, outputs: int = 2, is_monitored: bool = False
) -> Iterator[JackServer]:
    """A server of its own, without a sound card.

    It is synchronous, so that a machine that stalls delays samples and loses none; one that is
    monitored is not, as servers of sound cards are not.
    """
    environment = os.environ | {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}
    dummy = ["-d", "dummy", "-p", str(BLOCK), "-r", str(rate)]
    dummy += ["-C", str(inputs), "-P", str(outputs)]
    waiting, monitors = ([], ["-m"]) if is_monitored else (["-S"], [])
    with subprocess.Popen(
        ["jackd", "-n", name, *waiting, *JACK_PRIORITY, *dummy, *monitors],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
    ) as process:
        try:
            yield JackServer(process, environment)
        finally:
            process.terminate()


UNWATCHED = """
import sys
from era_haptics.command import main
from sim.soft_amp.engine import library
library().sound_release()
sys.exit(main())
"""
"""`era` whose software amplifier survives stalls: the kernel's timer that would kill it is off."""


def soft_amp_program(*, is_watched: bool) -> list[str]:
    """Return the start of a command line of `era soft-amp`.

    is_watched: whether the kernel kills it when its sound stalls for 0.1 s, which a busy machine
    may cause.
    """
    program = [str(ERA)] if is_watched else [sys.executable, "-c", UNWATCHED]
    return [*program, "soft-amp"]


class SoftAmp:
    """A running `era soft-amp`; url: of its first amplifier.

    is_watched: whether a stall of its sound for 0.1 s ends it.
    """

    def __init__(
        self, *options: str, environment: dict[str, str], log: Path, is_watched: bool = True
    ) -> None:
        self._log = log
        with log.open("wb") as errors:
            self.process = subprocess.Popen(
                [*soft_amp_program(is_watched=is_watched), *options, "--until-eof"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
            )
        self.url = self.process.stdout.readline().strip()

    @property
    def log(self) -> str:
        """What it has reported."""
        return self._log.read_text()

    def end(self) -> None:
        """End it as the end of its input does."""
        self.process.stdin.close()
        self.process.wait(START)
        self.process.stdout.close()
