"""`era` that waits for its amplifiers as long as a busy machine may take: `patient_daemon.py ...`.

With `--resting` first it waits as long for news of fingers. Its amplifiers wait as long for it.
What it does is the same; what it does about silence is not, which other tests have as their
subject.
"""

import sys

import pytest

PROGRAM = (sys.executable, __file__)
RESTING = (*PROGRAM, "--resting")
REPLY_TIMEOUT = 5.0  # s; in place of 30 ms
WATCHDOG = 2.0  # s; in place of 0.25 s, the longest of the protocol
CONTACT_TIMEOUT = 3.0  # s; in place of 0.15 s, no longer than that of TUIO


def wait_long(patch: pytest.MonkeyPatch) -> None:
    """Let amplifiers be waited for, and wait, that long in this process."""
    # Tests that only start this program need not load the daemon.
    from controller.daemon.daemon import Daemon
    from controller.operation.plate_controller import Controller
    from drivers.host.amplifier import Amplifier
    from drivers.host.group import Group
    from drivers.host.line import Line

    for method in (Line.submit, Amplifier.request):
        patch.setitem(method.__kwdefaults__, "timeout", REPLY_TIMEOUT)  # type: ignore[arg-type]
    patch.setattr("drivers.host.amplifier.COMMIT_DELAY", REPLY_TIMEOUT)
    for made in (Daemon, Controller, Group):
        patch.setitem(made.__init__.__kwdefaults__, "watchdog", WATCHDOG)  # type: ignore[arg-type]


if __name__ == "__main__":
    from controller.sources import touch
    from era_haptics.command import main

    patch = pytest.MonkeyPatch()
    wait_long(patch)
    if sys.argv[1:2] == ["--resting"]:
        patch.setattr(touch, "CONTACT_TIMEOUT", CONTACT_TIMEOUT)
        del sys.argv[1]
    sys.exit(main())
