"""The way of a stop: own functions from the bytes on the socket to the bytes on the wire.

    python tests/support/stop_path.py

A daemon in memory, armed, is sent one stop. Each callback of the event loop is known with what has
scheduled it, so that the chain of calls goes back to the bytes.
"""

import asyncio
import sys
import types
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import controller
import drivers
from controller.api.server import Connection
from daemons import Wire, ready_daemon, request, until
from virtual_lines import VirtualLoop, run_virtual

Function: TypeAlias = tuple[str, str]
"""File, and the name in it."""

_ROOT = Path(__file__).parents[2]
_OWN = tuple(str(Path(package.__path__[0])) for package in (controller, drivers))


class Chain:
    """The own functions that lead to the present one, over callbacks of the event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._before: tuple[Function, ...] = ()
        self._call_soon = loop.call_soon
        loop.call_soon = self._scheduled  # type: ignore[method-assign, assignment]

    def _scheduled(self, callback: Callable[..., Any], *args: Any, context: Any = None) -> Any:
        chain = self.here(sys._getframe(1))

        def run(*given: Any) -> None:
            self._before = chain
            callback(*given)
            self._before = ()

        return self._call_soon(run, *args, context=context)

    def here(self, frame: types.FrameType | None) -> tuple[Function, ...]:
        """The functions on the way to a frame, outermost first."""
        found: list[Function] = []
        while frame is not None:
            code = frame.f_code
            if code.co_filename.startswith(_OWN):
                file = Path(code.co_filename).relative_to(_ROOT).as_posix()
                found.append((file, code.co_qualname))
            frame = frame.f_back
        return tuple(dict.fromkeys((*self._before, *reversed(found))))


async def _stopped(folder: Path) -> tuple[tuple[Function, ...], int]:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    async with ready_daemon(folder) as (bench, era):
        await era.arm("a test", lease_s=60)
        client, wire = Connection(bench.daemon._server), Wire()
        client.connection_made(wire)
        await asyncio.sleep(0.01)
        chain, written, calls = Chain(loop), list[tuple[Function, ...]](), 0
        seen = loop.seen

        def first(*message: Any) -> None:
            written.append(chain.here(sys._getframe(1)))
            sys.setprofile(None)
            seen(*message)

        def count(frame: types.FrameType, event: str, _: object) -> None:
            nonlocal calls
            calls += event == "call" and frame.f_code.co_filename.startswith(_OWN)

        loop.seen = first
        line = request("stop", id=1)
        client.get_buffer(len(line))[: len(line)] = line
        sys.setprofile(count)
        client.buffer_updated(len(line))
        await until(lambda: wire.waiting)
        assert '"result"' in wire.waiting.decode(), wire.waiting
    return written[0], calls


def stop_path() -> tuple[tuple[Function, ...], int]:
    """The functions on the way of a stop, and how many own calls there are until its first byte."""
    with TemporaryDirectory() as folder:
        return run_virtual(_stopped(Path(folder)))


if __name__ == "__main__":
    path, calls = stop_path()
    owners = dict.fromkeys((file, name.rpartition(".")[0]) for file, name in path)
    lines = (f"{file} {name}" for file, name in path)
    sys.stdout.write("\n".join(lines) + f"\n{len(path)} functions of {len(owners)} owners, ")
    sys.stdout.write(f"{calls} own calls before the first byte\n")
