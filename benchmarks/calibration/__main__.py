"""How far a calibration's intervals hold: `python -m benchmarks.calibration [PLATES]`."""

import sys

from benchmarks.calibration import intervals

PLATES = 200

if __name__ == "__main__":
    intervals.main(int(sys.argv[1]) if len(sys.argv) > 1 else PLATES)
