"""`era daemon` that sleeps before it reads each frame of touches: `planted SECONDS CONFIG`.

The proof of the benchmark: just that time must appear in its figures.
"""

import sys
import time

from controller.cli.main import main
from controller.sources.touch import TouchFrame
from controller.sources.tuio import TuioReader
from controller.sources.udp_source import Peer

if __name__ == "__main__":
    delay, read = float(sys.argv[1]), TuioReader.read

    def read_late(
        self: TuioReader, datagram: bytes, peer: Peer, *, now: float
    ) -> TouchFrame | None:
        time.sleep(delay)
        return read(self, datagram, peer, now=now)

    TuioReader.read = read_late  # type: ignore[method-assign]
    sys.argv[1:2] = ["daemon"]
    sys.exit(main())
