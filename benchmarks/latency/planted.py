"""`era daemon` that sleeps before it reads each frame of touches: `planted SECONDS CONFIG`.

It validates the benchmark, whose figures must increase by exactly this time.
"""

import sys
import time

from controller.sources.touch import TouchFrame
from controller.sources.tuio import TuioSource
from controller.sources.udp_source import Peer
from era_haptics.command import main

if __name__ == "__main__":
    delay, read = float(sys.argv[1]), TuioSource.read

    def read_late(
        self: TuioSource, datagram: bytes, peer: Peer, arrived: float
    ) -> TouchFrame | None:
        time.sleep(delay)
        return read(self, datagram, peer, arrived)

    TuioSource.read = read_late  # type: ignore[method-assign]
    sys.argv[1:2] = ["daemon"]
    sys.exit(main())
