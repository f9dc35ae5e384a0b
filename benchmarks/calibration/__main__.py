"""How far a calibration's intervals hold: `python -m benchmarks.calibration [PLATES] [FORM]`."""

import sys

from benchmarks.calibration import intervals

PLATES, FORM = "200", "usual"

if __name__ == "__main__":
    plates, form = [*sys.argv[1:], *(PLATES, FORM)[len(sys.argv) - 1 :]]
    intervals.main(int(plates), form)
