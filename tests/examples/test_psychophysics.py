"""The study of the examples: its simulated observer's threshold, and the set that it writes."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import era_haptics as era

EXAMPLE = Path(__file__).parents[2] / "examples" / "psychophysics.py"
OBSERVER_DB_SL = 3.0
"""Threshold of the simulated observer relative to the rig's set."""


def run(*arguments: str, **environment: str) -> str:
    """Run Python in a process; return its output."""
    completed = subprocess.run(
        [sys.executable, *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert completed.returncode == 0, completed.stderr
    return completed.stdout


def test_study_finds_the_observers_threshold_and_writes_it_as_a_set(
    table_cache: Path, tmp_path: Path
) -> None:
    """Within the standard error; levels relative to the set are lower by the threshold."""
    pytest.importorskip("questplus")
    printed = run(str(EXAMPLE), str(tmp_path), "--trials", "30", XDG_CACHE_HOME=str(table_cache))

    found = re.search(r"detection: threshold (\S+) \+- (\S+) dB SL", printed)
    assert found, printed
    threshold, error = float(found[1]), float(found[2])
    assert error < 3
    assert threshold == pytest.approx(OBSERVER_DB_SL, abs=error)
    assert len((tmp_path / "trials.csv").read_text().splitlines()) == 61

    program = (
        "import era_haptics as era\n"
        "rig = era.change_rig(era.load_rig(era.example_rig_path()), threshold='observer')\n"
        "print(*era.detection_threshold([60.0, 250.0], rig.threshold))\n"
        "print(*rig.promised_thresholds)\n"
    )
    accelerations, promised = run(
        "-c", program, ERA_HAPTICS_THRESHOLDS=str(tmp_path / "thresholds")
    ).splitlines()
    published = era.detection_threshold(np.array([60.0, 250.0]))
    ratios = np.array(accelerations.split(), dtype=float) / published
    assert 20 * np.log10(ratios) == pytest.approx(threshold, abs=0.1)
    assert promised == "pressing-fingertip vibrotactile-probe"
