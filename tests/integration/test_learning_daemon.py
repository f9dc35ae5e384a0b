"""A daemon whose plate changes: its estimator, a process of its own, and what touches get of it."""

import asyncio
import functools
import os
import selectors
import signal
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np
import pytest

from controller.api.client import AsyncClient
from controller.api.schema import LearningSummary
from controller.daemon.daemon import Daemon
from controller.demo.recorder import FingerVibration, steady_contrast_db
from controller.learning.estimator_process import EstimatorTimeouts
from controller.learning.learning import Learning
from daemons import daemon_at, far_end, ready
from model.identification.learned_plate import load_learned
from model.rig.rig import Rig
from model.rig.rig_file import load_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from real_wires import FarSide
from registry import threads
from virtual_lines import VirtualLoop

P = ParamSpec("P")
T = TypeVar("T")
Place = tuple[float, float]

IDENTIFIED = (
    "uncertainty: {gain: 1 %, phase_deg: 1, thickness: 0.2 %, stiffness: 1 %, damping: 1.05, "
    "fingertip: 0.5}\n"
)
"""Of a rig's file: what an identification leaves."""

NO_TIMEOUTS = EstimatorTimeouts(start=1e9, estimate=1e9)
_APART, _MARGIN = 0.05, 0.02  # m
_FELT = 0.2  # s
_REAL_WAIT = 0.05  # s; for a reply of the process


@dataclass
class LearningBench:
    """A daemon that learns, its far end, and an armed client."""

    far: FarSide
    era: AsyncClient
    file: Path
    daemon: Daemon
    rng: np.random.Generator
    stands: bool = True

    @property
    def estimator(self) -> int:
        """Process number of the estimator."""
        assert self.daemon.learning is not None
        assert self.daemon.learning.estimator_pid is not None
        return self.daemon.learning.estimator_pid

    def is_estimating(self) -> bool:
        """Whether the estimator works, so that time is to stand still."""
        learning = self.daemon.learning
        if learning is None or learning.estimator_pid is None or not self.stands:
            return False
        status = learning.status
        is_starting = status.state in ("starting", "restarting")
        return is_starting or status.estimates + status.discarded < status.readings

    async def learning(self) -> LearningSummary:
        """What it has learned."""
        found = (await self.era.status()).learning
        assert found is not None
        return found

    async def until(self, *states: str) -> LearningSummary:
        """Wait until it is in one of these states."""
        while True:
            found = await self.learning()
            if found.state in states:
                return found
            await asyncio.sleep(0.05)

    def change(self, **stiffness: float) -> None:
        """Multiply the stiffness of mounts, by ERA."""
        plate = replace(self.far.bench.imperfections.plate, stiffness=stiffness)
        self.far.bench.change_plate(plate, now=threads.now())

    def places(self) -> list[Place]:
        """Two or three fingers at random."""
        plate = self.far.bench.rig.plate
        size = np.array([plate.length, plate.width])
        count = int(self.rng.integers(2, 4))
        while True:
            found = self.rng.uniform(_MARGIN, size - _MARGIN, (count, 2))
            gaps = np.linalg.norm(found[:, None] - found, axis=-1)
            if gaps[np.triu_indices(count, 1)].min() > _APART:
                return [(float(x), float(y)) for x, y in found]

    async def touch(self, *places: Place, seconds: float = 1.2) -> float | None:
        """Fingers rest on the plate; contrast felt by the last one [dB], None if nothing plays."""
        named = {f"finger {number}": place for number, place in enumerate(places)}
        self.far.bench.place_fingers(named, now=threads.now())
        end = threads.now() + seconds
        while threads.now() < end:
            await self.era.touch(list(places))
            await asyncio.sleep(0.05)
        is_playing = any(self.far.summary().levels)
        self.far.bench.advance(threads.now())
        felt = self.far.bench.felt(threads.now() - _FELT, threads.now())
        *quiet, target = [
            FingerVibration(np.array(f.frequencies), f.amplitude, f.peak, f.weights)
            for f in (felt[name] for name in named)
        ]
        await self.era.touch([])
        self.far.bench.place_fingers({}, now=threads.now())
        await asyncio.sleep(0.3)
        return steady_contrast_db(target, quiet) if is_playing else None

    async def patterns(self, count: int) -> LearningSummary:
        """Touch at random until so many patterns more are estimated."""
        requested = (await self.learning()).estimates + count
        while (found := await self.learning()).estimates < requested:
            if found.readings < requested:
                await self.touch(*self.places())
            else:
                await asyncio.sleep(0.05)
        return found


@asynccontextmanager
async def learning_bench(
    folder: Path, *, uncertainty: str = IDENTIFIED, timeouts: EstimatorTimeouts = NO_TIMEOUTS
) -> AsyncIterator[LearningBench]:
    """A daemon that learns of a plate; uncertainty: in its rig's text."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, _StandingLoop)
    changes = [("\nplate:", f"\n{uncertainty}plate:")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(Learning.__init__.__kwdefaults__, "timeouts", timeouts)  # type: ignore[arg-type]
        async with (
            far_end(folder, changes=changes) as far,
            daemon_at(far, folder, "learn: learned.npz\n", changes=changes, table=_table) as bench,
            await bench.client() as era,
        ):
            await ready(era)
            async with era.armed("test", lease_s=60):
                rng = np.random.default_rng(0)
                learning = LearningBench(far, era, folder / "learned.npz", bench.daemon, rng)
                loop.stands = learning.is_estimating
                try:
                    yield learning
                finally:
                    loop.stands = _never


def _table(rig: Rig) -> LocalizationTable:
    return build_table(rig, drive_mode="phased")


def _never() -> bool:
    return False


class _StandingLoop(VirtualLoop):
    """Virtual time that stands still while `stands` says so; sockets and pipes are served."""

    def __init__(self) -> None:
        super().__init__()
        self.stands: Callable[[], bool] = _never
        jumping = self._selector.select

        def select(timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
            if timeout != 0 and self.stands():
                return selectors.DefaultSelector.select(self._selector, _REAL_WAIT)
            return jumping(timeout)

        self._selector.select = select


def beside_a_process(test: Callable[P, Coroutine[object, object, T]]) -> Callable[P, T]:
    """Run a test in virtual time that passes while a real process works."""

    @functools.wraps(test)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        with asyncio.Runner(loop_factory=_StandingLoop) as runner:
            return runner.run(test(*args, **kwargs))

    return run


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
    table = _table(load_rig(bench.file.with_name("rig.yaml")))
    assert load_learned(bench.file, table=table.fingerprint).names


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
    """With the thickness of a drawing, to 2 %, answers stay as built, and the cause says so."""
    async with learning_bench(tmp_path, uncertainty="uncertainty: {}\n") as bench:
        found = await bench.until("only_alarms")
        assert "thickness" in found.cause
        found = await bench.patterns(1)
        assert found.corrections == 0
