"""Work in threads, finished or cancelled, and suggestions for mistyped names."""

import asyncio
import gc
import subprocess
import sys
import threading
from collections.abc import Awaitable

import pytest

from registry.plugins import did_you_mean
from registry.threads import (
    DaemonThreads,
    in_thread,
    no_long_collections,
    without_collections,
)


async def test_result_at_the_moment_of_cancellation_is_undone() -> None:
    """The result exists, but the cancelled task has not received it."""
    closed = threading.Event()
    loop = asyncio.get_running_loop()

    def open_port() -> str:
        opener = threading.current_thread()

        def cancel_next() -> None:
            opener.join()  # so that its result precedes the cancellation, with nothing between
            loop.call_soon(opening.cancel)

        loop.call_soon_threadsafe(cancel_next)
        return "port"

    opening = asyncio.create_task(
        in_thread(open_port, name="opening", undo=lambda port: closed.set())
    )
    with pytest.raises(asyncio.CancelledError):
        await opening
    assert await asyncio.to_thread(closed.wait, 60)


def test_result_after_the_end_of_the_loop_is_undone() -> None:
    """The thread that opened it closes it."""
    may_open, closed = threading.Event(), threading.Event()

    async def give_up() -> None:
        opening = asyncio.create_task(
            in_thread(lambda: may_open.wait(60), name="opening", undo=lambda _: closed.set())
        )
        await asyncio.sleep(0)
        opening.cancel()
        await asyncio.wait({opening})

    asyncio.run(give_up())
    may_open.set()
    assert closed.wait(60)


@pytest.mark.parametrize("executor", [None, DaemonThreads()], ids=["in_thread", "executor"])
async def test_awaiter_gets_an_error_when_work_tries_to_end_the_program(
    executor: DaemonThreads | None,
) -> None:
    """A plug-in that calls sys.exit(3) fails like any other, and nothing waits for it."""

    def leave() -> None:
        sys.exit(3)

    work: Awaitable[None]
    if executor is None:
        work = in_thread(leave, name="leaves")
    else:
        work = asyncio.wrap_future(executor.submit(leave))
    with pytest.raises(RuntimeError, match=r"SystemExit\(3\)"):
        await asyncio.wait_for(work, timeout=10)


@pytest.mark.parametrize(
    "start",
    [
        "asyncio.create_task(in_thread(hang, name='hangs'))",
        "loop.run_in_executor(DaemonThreads(), hang)",
        "loop.set_default_executor(DaemonThreads()) or loop.run_in_executor(None, hang)",
    ],
)
def test_program_ends_while_work_hangs(start: str) -> None:
    """Unlike with asyncio's own pool; also where a library would wait at the end for its own."""
    program = f"""
import asyncio, atexit, threading
from registry.threads import DaemonThreads, in_thread, leave_work

hang = threading.Event().wait
atexit.register(hang)
atexit.register(leave_work)

async def main():
    loop = asyncio.get_running_loop()
    work = {start}
    await asyncio.sleep(0.1)
    work.cancel()
    await asyncio.wait({{work}})

asyncio.run(main())
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_present_objects_are_frozen_during_the_context() -> None:
    """All objects present at its start, and none afterwards."""
    with no_long_collections():
        assert gc.get_freeze_count() > 1000
    assert gc.get_freeze_count() == 0


def test_objects_built_without_collections_are_never_visited() -> None:
    """Many are frozen; of few nothing is, or the garbage of repeated failures would pile up."""
    try:
        for count, is_frozen in ((1_000, False), (100_000, True)):
            gc.collect()
            gc.unfreeze()
            with without_collections():
                assert not gc.isenabled()
                objects = [[number] for number in range(count)]
            assert gc.isenabled()
            assert (gc.get_freeze_count() >= len(objects)) is is_frozen
    finally:
        gc.unfreeze()


@pytest.mark.parametrize(
    ("name", "choices", "suggestion"),
    [
        ("aluminum", ["steel", "aluminium"], "did you mean aluminium? "),
        ("sw", ["SW", "SE"], "did you mean SW? "),
        ("Steal", ["iron", "steel"], "did you mean steel? "),
        ("unobtainium", ["steel", "aluminium"], ""),
        (
            "Glass",
            ["soda-lime-glass", "steel", "gorilla-glass"],
            "did you mean soda-lime-glass or gorilla-glass? ",
        ),
        ("lass", ["soda-lime-glass"], ""),
        ("level", ["rig", "level_db_sl", "log"], "did you mean level_db_sl? "),
        ("", ["steel"], ""),
        ("x", [], ""),
    ],
)
def test_did_you_mean_suggests_similar_names(
    name: str, choices: list[str], suggestion: str
) -> None:
    """Mistyped names, another case and one word of a name are understood."""
    assert did_you_mean(name, choices) == suggestion
