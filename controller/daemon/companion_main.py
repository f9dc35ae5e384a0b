"""`python -m controller.daemon.companion_main DAEMON MODULE ...`: a module that ends with it.

DAEMON is the number of the process that starts this one. On Linux the system ends the module when
that one is gone, however it went.
"""

import ctypes
import os
import runpy
import signal
import sys

_PR_SET_PDEATHSIG = 1  # of prctl(2)


def _main() -> None:
    daemon, module = int(sys.argv[1]), sys.argv[2]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != daemon:
        return  # it went before
    sys.argv[:] = [module, *sys.argv[3:]]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _main()
