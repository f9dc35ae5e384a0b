"""Benchmarks of contrast, promises, time and accuracy, each run as `python -m benchmarks.NAME`.

Linear algebra uses a single thread, which is set here before a benchmark loads numpy. Simulations
in virtual time and reference solvers are shared with the tests.
"""

import os
import sys
from pathlib import Path

for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ[f"{library}_NUM_THREADS"] = "1"

_SUPPORT = str(Path(__file__).parents[1] / "tests" / "support")
if _SUPPORT not in sys.path:
    sys.path.append(_SUPPORT)
