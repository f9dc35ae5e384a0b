"""Run a command beside six processes that compute without pause: `busy_machine.py COMMAND ...`."""

import contextlib
import subprocess
import sys

PROCESSES = 6
COMPUTING = (sys.executable, "-c", "while True: pass")


def main() -> int:
    """Run it; the exit status is its own."""
    with contextlib.ExitStack() as stack:
        for _ in range(PROCESSES):
            stack.callback(subprocess.Popen(COMPUTING).kill)
        return subprocess.run(sys.argv[1:], check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
