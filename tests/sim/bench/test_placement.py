"""Fingers whose plate is solved apart: the amplifiers go on, and what is felt is the same."""

import asyncio
import json
import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from bench_driving import keep_alive, play
from drivers.contents import Tone
from model.rig.rig import Rig
from model.structure.attachments import Fingertip
from sim.bench.bench import Bench
from sim.control.context import SimulationContext
from sim.control.operations import carry_out
from sim.plant.loaded_plates import LoadedPlate, Placement

A, B, C = (0.1, 0.07), (0.29, 0.2), (0.2, 0.1)


@pytest.fixture
def rig(coarse_rig: Rig) -> Rig:
    """A rig whose fingers load the plate."""
    return replace(coarse_rig, fingertip=Fingertip(2000.0, 3.0, 0.005))


@pytest.fixture
def let_solve(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Solutions wait for this event."""
    event, solved = threading.Event(), Placement.solved

    def wait(placement: Placement) -> LoadedPlate | None:
        assert event.wait(60)
        return solved(placement)

    monkeypatch.setattr(Placement, "solved", wait)
    return event


def driven(rig: Rig, place: Callable[[Bench], None]) -> Bench:
    """A bench that plays on through a touch at 0.5 s, up to 1.2 s."""
    bench = Bench(rig, now=0.0)
    bench.place_fingers({"a": A}, now=0.0)
    play(bench, Tone(1, 210.0, 1.0), now=bench.time, ramp=0.02, watchdog=2.0)
    keep_alive(bench, 0.5)
    place(bench)
    keep_alive(bench, 1.2)
    return bench


def test_finger_that_is_solved_late_is_felt_as_one_that_is_solved_at_once(rig: Rig) -> None:
    """The plate waits for it, so that samples before and after it are the same."""
    late = driven(rig, lambda one: one.begin_placing({"a": A, "b": B}, now=one.time))
    at_once = driven(rig, lambda one: one.place_fingers({"a": A, "b": B}, now=one.time))
    for since, until in ((0.1, 0.5), (0.51, 1.2)):
        ours, theirs = (bench.records(since, until)[0] for bench in (late, at_once))
        assert ours.keys() == theirs.keys()
        for name, record in ours.items():
            np.testing.assert_array_equal(record.times, theirs[name].times)
            peak = np.abs(theirs[name].accelerations).max()
            np.testing.assert_allclose(
                record.accelerations, theirs[name].accelerations, rtol=0, atol=1e-5 * peak
            )
    assert late.unsolved is None


def test_slide_faster_than_it_is_solved_leaves_out_places_between(rig: Rig) -> None:
    """Of a finger's landing, three moves and its lift, two moves are never solved."""
    bench = Bench(rig, now=0.0)
    for number, at in enumerate((A, B, C, A)):
        bench.begin_placing({"a": at}, now=0.02 * number)
    bench.begin_placing({}, now=0.1)
    solved = []
    while (placement := bench.unsolved) is not None:
        placement.solved()
        solved.append((placement.time, placement.positions))
    assert solved == [(0.0, {"a": A}), (pytest.approx(0.06), {"a": A}), (0.1, {})]


async def test_control_replies_while_the_plate_is_solved(
    rig: Rig, let_solve: threading.Event
) -> None:
    """A finger comes and the state is read before its plate is solved; what it feels waits."""
    context = SimulationContext(Bench(rig, now=0.0))

    async def ask(now: float, **request: object) -> dict[str, object]:
        return await carry_out(context, json.dumps(request).encode(), now=now)

    assert (await ask(0.1, op="fingers", fingers={"a": A}))["ok"]
    assert (await ask(0.4, op="state"))["fingers"] == {"a": list(A)}
    felt = asyncio.create_task(ask(0.4, op="felt", since_s=0.1, until_s=0.4))
    await asyncio.sleep(0)
    assert context.bench.unsolved is not None
    let_solve.set()
    fingers = (await felt)["fingers"]
    assert isinstance(fingers, dict)
    assert fingers.keys() == {"a"}
    await context.stop_solving()
