"""What the latency benchmark measures from outside, beside what the daemon says of itself."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import patient_daemon

pytestmark = pytest.mark.real_time

ROOT = Path(__file__).parents[2]
SECONDS, TOUCHES = 1.5, 150
CHECK = (
    "from benchmarks.latency import __main__, run; from patient_daemon import PROGRAM;"
    "run.DAEMON = (*PROGRAM, 'daemon'); __main__.main()"
)
"""The benchmark, of a daemon that waits for a busy machine."""


@pytest.fixture(scope="module")
def measured(table_cache: Path) -> dict[str, Any]:
    """Taps at 100 Hz over TCP, every part a process of its own."""
    run = subprocess.run(
        [
            *(sys.executable, "-c", CHECK),
            *("--check", "tcp", "--seconds", str(SECONDS)),
        ],
        cwd=ROOT,
        env={
            **os.environ,
            "PYTHONWARNINGS": "ignore",
            "PYTHONPATH": str(Path(patient_daemon.__file__).parent),
            "XDG_CACHE_HOME": str(table_cache),
        },
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    found: dict[str, Any] = json.loads(run.stdout)
    return found


def test_every_command_matches_a_touch(measured: dict[str, Any]) -> None:
    """Each set on the wire plays what the table answers for a touch, each for a newer one."""
    assert measured["sent"] == TOUCHES
    assert measured["unmatched"] == 0
    touches = measured["touch"]
    assert touches == sorted(set(touches))
    assert touches[-1] == TOUCHES - 1  # the last is never superseded
    assert len(touches) > 1


def test_latency_includes_the_wait_before_reading(measured: dict[str, Any]) -> None:
    """Where a set answers the touch after the one before, both latencies are one; else more."""
    newest, oldest = np.array(measured["newest_ms"]), np.array(measured["oldest_ms"])
    skipped = np.diff(measured["touch"], prepend=measured["touch"][0] - 1) > 1
    assert (newest > 0).all()
    assert (oldest[~skipped] == newest[~skipped]).all()
    assert (oldest[skipped] > newest[skipped]).all()


def test_daemon_counts_every_command(measured: dict[str, Any]) -> None:
    """Those that are seen outside, and silences; how long each took is the benchmark's to say."""
    own = measured["own"]
    assert own["count"] >= len(measured["oldest_ms"])
    assert sum(count for _, count in own["histogram"]) == own["count"]
    assert own["median"] > 0
