"""`era` for tests on a machine that stalls for seconds: `patient_daemon.py [--resting] ...`.

The daemon waits longer for its amplifiers, and they wait longer for the daemon. With `--resting`,
fingers also stay longer without news. Tests whose subject is one of these times use `era` itself.
"""

import sys
from typing import Any

import pytest

PROGRAM = (sys.executable, __file__)
RESTING = (*PROGRAM, "--resting")
REPLY_TIMEOUT = 5.0  # s; in place of 30 ms
WATCHDOG = 2.0  # s; in place of 0.25 s, the longest of the protocol
LONG_WATCHDOG = 60.0  # s; for amplifiers within reach of `allow_long_watchdogs`
CONTACT_TIMEOUT = 3.0  # s; in place of 0.15 s, no longer than that of TUIO


def wait_long(patch: pytest.MonkeyPatch, reply_timeout: float = REPLY_TIMEOUT) -> None:
    """Let hosts in this process wait longer for amplifiers, which wait as long as they can.

    reply_timeout: of each attempt [s].
    """
    # Tests that only start this program need not load the daemon.
    from controller.daemon.daemon import Daemon
    from controller.operation.plate_controller import Controller
    from drivers.host.amplifier import Amplifier
    from drivers.host.group import Group
    from drivers.host.line import Line
    from drivers.protocol.definition import QUANTITIES

    for method in (Line.submit, Amplifier.request, Amplifier.identify):
        patch.setitem(method.__kwdefaults__, "timeout", reply_timeout)  # type: ignore[arg-type]
    for constant in ("set_admission.COMMIT_DELAY", "amplifier.REPLY_TIMEOUT"):
        patch.setattr(f"drivers.host.{constant}", reply_timeout)
    for patched in (Daemon, Controller, Group):
        patch.setitem(patched.__init__.__kwdefaults__, "watchdog", LONG_WATCHDOG)  # type: ignore[arg-type]
    arm = Amplifier._arm

    async def arm_for_long(
        amplifier: Amplifier, session: int, watchdog: float, *options: Any
    ) -> Any:
        longest = QUANTITIES["watchdog"].from_wire(amplifier.capabilities["watchdog_max"])
        return await arm(amplifier, session, min(watchdog, longest), *options)

    patch.setattr(Amplifier, "_arm", arm_for_long)


def allow_long_watchdogs(patch: pytest.MonkeyPatch) -> None:
    """Let hosts and simulated amplifiers in this process take watchdogs of up to LONG_WATCHDOG.

    The protocol ends at 2 s, by which a test with a host and amplifiers would have to run.
    """
    from drivers.protocol.definition import QUANTITIES

    for name in ("watchdog", "watchdog_left"):
        quantity = QUANTITIES[name]
        longest = round(LONG_WATCHDOG * quantity.per_unit)
        patch.setitem(vars(quantity), "maximum", longest)


def _main() -> int:
    from controller.sources import touch
    from era_haptics.command import main

    patch = pytest.MonkeyPatch()
    wait_long(patch)
    allow_long_watchdogs(patch)
    if sys.argv[1:2] == ["--resting"]:
        patch.setattr(touch, "CONTACT_TIMEOUT", CONTACT_TIMEOUT)
        del sys.argv[1]
    return main()


if __name__ == "__main__":
    sys.exit(_main())
