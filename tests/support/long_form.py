"""Cases of which `make test` takes a few; `make test-long` takes the others.

The files of tests that take longest.

A disk that is full, as a process sees it.
"""

import contextlib
import resource
import sys
from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import cycle
from typing import Any

import pytest


def shortly(values: Iterable[Any], short: Collection[Any]) -> list[Any]:
    """Values for `parametrize`, long ones marked; short: those that `make test` takes."""
    return [value if value in short else _long(value) for value in values]


def in_turn(rows: Iterable[Any], columns: Sequence[Any]) -> list[Any]:
    """All pairs of a row and a column; `make test` takes every row, and the columns in turn."""
    return [
        (row, column) if column == taken else _long(row, column)
        for row, taken in zip(rows, cycle(columns), strict=False)
        for column in columns
    ]


def _long(*values: Any) -> Any:
    return pytest.param(*values, marks=pytest.mark.long)


SLOWEST = (
    "test_dashboard.py",
    "test_demo.py",
    "test_desk.py",
    "test_daemon_faults_process.py",
    "test_how_to_pages.py",
    "test_firmware_host.py",
    "test_latency_measured.py",
    "test_errors.py",
    "test_link_faults.py",
    "test_dashboard_losses.py",
    "test_rig_check.py",
    "test_tutorials.py",
    "test_calibration.py",
    "test_diagnosis.py",
    "test_daemon_over_a_wire.py",
    "test_soak.py",
    "test_soft_amp_sound.py",
    "test_group_stops.py",
    "test_convergence.py",
    "test_table_commands.py",
    "test_quick_faults.py",
    "test_calibrate_on_the_bench.py",
    "test_identify.py",
    "test_consistency.py",
    "test_layout_check.py",
)
"""Run in this order before all others: one that started last would leave the other cores idle."""


@contextlib.contextmanager
def full_disk(*, at: int = 1024) -> Iterator[None]:
    """No file may become longer than so many bytes: what is written beyond raises OSError.

    Python writes no bytecode meanwhile: it does not notice that a file was cut off, and later
    imports of the module fail.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    writes_none = sys.dont_write_bytecode
    sys.dont_write_bytecode = True
    resource.setrlimit(resource.RLIMIT_FSIZE, (at, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        sys.dont_write_bytecode = writes_none
