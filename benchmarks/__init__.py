"""Benchmarks: what the plate gives and what it costs, each run as `python -m benchmarks.NAME`.

Linear algebra has one thread in all of them: set here, before any of them loads numpy.
"""

import os

os.environ.update(
    dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)
