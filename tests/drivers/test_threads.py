"""Work in threads, finished or cancelled."""

import asyncio
import subprocess
import sys
import threading

import pytest

from drivers.threads import in_thread


async def test_result_at_the_moment_of_cancellation_is_undone() -> None:
    """The result exists, but the cancelled task has not received it."""
    closed = threading.Event()
    loop = asyncio.get_running_loop()

    def open_port() -> str:
        opener = threading.current_thread()

        def cancel_next() -> None:
            opener.join()  # so that what it gives is before the cancellation, and nothing between
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
from drivers.threads import DaemonThreads, in_thread, leave_work

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
