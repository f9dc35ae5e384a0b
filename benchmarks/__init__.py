"""Benchmarks of contrast, promises, time and accuracy, each run as `python -m benchmarks.NAME`.

Linear algebra has one thread in all of them: set here, before any of them loads numpy. Chains in
virtual time and reference solvers are those of the tests.
"""

import os
import sys
from pathlib import Path

for library in ("OPENBLAS", "OMP", "MKL"):
    os.environ[f"{library}_NUM_THREADS"] = "1"

_SUPPORT = str(Path(__file__).parents[1] / "tests" / "support")
if _SUPPORT not in sys.path:
    sys.path.append(_SUPPORT)
