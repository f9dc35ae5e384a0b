"""What the latency benchmark measures from outside, beside what the daemon says of itself.

Its short form starts no process: test_latency_report.py.
"""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.latency import run
from benchmarks.latency.report import check_case
from model.rig.file import example_rig_path, load_rig
from model.table.file import save_table
from model.table.table_cache import cached_table
from patient_daemon import LOADING

pytestmark = [pytest.mark.long, pytest.mark.alone]

SECONDS, TOUCHES = 1.0, 100


@pytest.fixture(scope="module")
def measured(table_cache: Path, tmp_path_factory: pytest.TempPathFactory) -> run.Found:
    """Taps at 100 Hz over TCP, every part a process of its own; the daemon is a patient one."""
    file = tmp_path_factory.mktemp("latency") / "table.npz"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(table_cache))
        patch.setattr(run, "DAEMON", LOADING)
        table, _ = cached_table(load_rig(example_rig_path()))
        save_table(table, file)
        return run.measure(check_case("tcp", SECONDS, seed=1), file, table)


def test_every_command_matches_a_touch(measured: run.Found) -> None:
    """Each set on the wire plays what the table answers for a touch, each for a newer one."""
    assert measured.sent == TOUCHES
    assert measured.matched.unmatched == 0
    touches = measured.matched.touch.tolist()
    assert touches == sorted(set(touches))
    assert touches[-1] == TOUCHES - 1  # the last is never superseded
    assert len(touches) > 1


def test_latency_includes_the_wait_before_reading(measured: run.Found) -> None:
    """Where a set answers the touch after the one before, both latencies are one; else more."""
    matched = measured.matched
    skipped = np.diff(matched.touch, prepend=matched.touch[0] - 1) > 1
    assert (matched.newest > 0).all()
    assert (matched.oldest[~skipped] == matched.newest[~skipped]).all()
    assert (matched.oldest[skipped] > matched.newest[skipped]).all()


def test_daemon_counts_every_command(measured: run.Found) -> None:
    """Those that are seen outside, and silences; how long each took is the benchmark's to say."""
    own = measured.own
    assert own is not None
    assert own.count >= len(measured.matched.oldest)
    assert sum(count for _, count in own.histogram) == own.count
    assert own.median is not None
    assert own.median > 0
