"""`era` that waits for its amplifiers as long as a busy machine may take: `patient_daemon.py ...`.

Its amplifiers wait as long for it. What it does is the same; what it does about silence is not,
which other tests have as their subject.
"""

import sys

from controller.cli.main import main
from drivers.amplifier import Amplifier
from drivers.operation.checked_amplifier import CheckedAmplifier

REPLY_TIMEOUT = 5.0  # s; in place of 30 ms
WATCHDOG = 2.0  # s; in place of 0.25 s, the longest of the protocol

if __name__ == "__main__":
    assert Amplifier.__init__.__kwdefaults__ is not None
    Amplifier.__init__.__kwdefaults__["reply_timeout"] = REPLY_TIMEOUT
    CheckedAmplifier.arm.__defaults__ = (WATCHDOG,)
    sys.exit(main())
