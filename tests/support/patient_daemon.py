"""`era` that waits for its amplifiers as long as a busy machine may take: `patient_daemon.py ...`.

Its amplifiers wait as long for it. What it does is the same; what it does about silence is not,
which other tests have as their subject.
"""

import sys

import pytest

from controller.cli.main import main
from drivers.amplifier import Amplifier
from drivers.operation.checked_amplifier import CheckedAmplifier

PROGRAM = (sys.executable, __file__)
REPLY_TIMEOUT = 5.0  # s; in place of 30 ms
WATCHDOG = 2.0  # s; in place of 0.25 s, the longest of the protocol


def wait_long(patch: pytest.MonkeyPatch) -> None:
    """Let amplifiers be waited for, and wait, that long in this process."""
    patch.setitem(Amplifier.__init__.__kwdefaults__, "reply_timeout", REPLY_TIMEOUT)  # type: ignore[arg-type]
    patch.setattr(CheckedAmplifier.arm, "__defaults__", (WATCHDOG,))


if __name__ == "__main__":
    wait_long(pytest.MonkeyPatch())
    sys.exit(main())
