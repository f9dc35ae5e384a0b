"""A daemon whose plate changes: its estimator, a process of its own, and what touches get of it."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest

from controller.learning.estimator_process import EstimatorTimeouts
from learning_bench import LearningBench, beside_a_process, learning_bench
from model.identification.learned_file import load_learned

PAIRS = (
    ((0.24, 0.06), (0.06, 0.17)),
    ((0.07, 0.06), (0.22, 0.17)),
    ((0.15, 0.19), (0.16, 0.05)),
)
PAIR = PAIRS[0]


@pytest.mark.long
@beside_a_process
async def test_loose_mount_is_named_and_its_contrast_comes_back(tmp_path: Path) -> None:
    """A mount 20 % softer is named; the same touches then get 3 dB more, and it is kept on disk."""
    async with learning_bench(tmp_path) as bench:
        await bench.until("following")
        await bench.patterns(6)
        bench.change(NE=0.8)
        before = await contrast(bench)
        while not (found := await bench.learning()).cause.startswith("the plate has changed"):
            await bench.patterns(1)
        assert "stiffness NE" in found.cause
        assert found.corrections > 0
        assert found.latency_ms.count > 0
        assert await contrast(bench) > before + 3
        while not bench.file.exists():  # written now and then
            await bench.patterns(1)
    assert load_learned(bench.file).names


async def contrast(bench: LearningBench) -> float:
    """Median contrast of some touches [dB]."""
    found = [await bench.touch(*pair) for pair in PAIRS]
    return float(np.median([each for each in found if each is not None]))


@beside_a_process
async def test_touches_go_on_without_an_estimator(tmp_path: Path) -> None:
    """Killed, another follows; stopped, it is replaced; meanwhile and after touches play."""
    timeouts = EstimatorTimeouts(start=1e9, estimate=3.0)
    async with learning_bench(tmp_path, timeouts=timeouts) as bench:
        await bench.until("following")
        first = bench.estimator
        os.kill(first, signal.SIGKILL)
        await bench.until("restarting")
        assert await bench.touch(*PAIR) is not None
        await bench.until("following")
        second = bench.estimator
        assert second != first
        bench.stands = False
        os.kill(second, signal.SIGSTOP)
        while (found := await bench.learning()).state == "following":
            assert await bench.touch(*PAIR) is not None
        assert "no reply within 3 s" in found.cause
        await bench.until("following")
        assert (await bench.learning()).restarts == 2


@beside_a_process
async def test_plate_that_was_not_measured_is_only_watched(tmp_path: Path) -> None:
    """With a thickness to 2 % answers stay as built, and the cause says so."""
    async with learning_bench(tmp_path, uncertainty="uncertainty: {thickness: 2 %}\n") as bench:
        found = await bench.until("only_alarms")
        assert "thickness" in found.cause
        found = await bench.patterns(1)
        assert found.corrections == 0
