"""`era daemon` whose touches wait for a shaped onset for another time than usual.

    python -m benchmarks.latency.daemon SECONDS CONFIG

0 for plain ramps without delay.
"""

import sys

from controller.cli.main import main
from controller.loop.loop import Controller


def run_daemon() -> int:
    """Run it with the arguments of this process; return the exit status."""
    Controller.__init__.__kwdefaults__["max_loading_time"] = float(sys.argv[1])  # type: ignore[index]
    sys.argv[1:2] = ["daemon"]
    return main()


if __name__ == "__main__":
    sys.exit(run_daemon())
