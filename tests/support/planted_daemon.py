"""`era` with a bug planted in it: python planted_daemon.py BUG daemon daemon.yaml."""

import sys
from dataclasses import replace

import pytest

from planted_bugs import Bug, lifts_are_dropped, routed

BUGS = {
    "phases have the other sign": Bug("phase", routed(lambda one: replace(one, phase=-one.phase))),
    "lifts are dropped": Bug("lift", lifts_are_dropped),
}
"""By name. The daemon's own reports show none of them; what a finger feels does."""


if __name__ == "__main__":
    from controller.cli.main import main

    BUGS[sys.argv.pop(1)].plant(pytest.MonkeyPatch())
    sys.exit(main())
