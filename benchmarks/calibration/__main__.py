"""How far a calibration's intervals hold: `python -m benchmarks.calibration [PLATES] [SHARE]`."""

import sys

from benchmarks.calibration import intervals

PLATES, SHARE = "200", "1"

if __name__ == "__main__":
    plates, share = [*sys.argv[1:], *(PLATES, SHARE)[len(sys.argv) - 1 :]]
    intervals.main(int(plates), float(share))
