"""`era daemon` with shaped onsets, or with plain ramps.

    python -m benchmarks.latency.daemon SECONDS CONFIG

0 for plain ramps; other times for what the wire carries.
"""

import sys

from controller.cli.main import main
from controller.loop import capabilities
from controller.loop.envelopes import RAMPS_ONLY


def run_daemon() -> int:
    """Run it with the arguments of this process; return the exit status."""
    if float(sys.argv[1]) <= 0:
        vars(capabilities)["envelope_support"] = lambda rig, amplifiers: RAMPS_ONLY
    sys.argv[1:2] = ["daemon"]
    return main()


if __name__ == "__main__":
    sys.exit(run_daemon())
