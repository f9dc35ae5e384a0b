"""The ways of a touch, a stop, a question and a build through the project's own files.

    python tests/support/ways.py

A daemon in memory, armed, has a finger that rests; another comes by a TUIO datagram. Its way: all
that is called until the last byte of its set is written, far ends and judges left out, in virtual
time. The stop: what leads from the bytes of the request to those on the wire; each callback of the
event loop is known with what has scheduled it. A question is asked and a table built by the public
functions.
"""

import asyncio
import re
import sys
import types
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from controller.api.server import Connection
from controller.sources import udp_source
from controller.sources.touch import Touch, TouchFrame
from era_haptics import query
from examples.make_touches import tuio_datagram
from kit.clock import VirtualLoop, run_virtual
from model.rig.rig_file import load_rig
from model.table.table_file import build_table
from processes.daemons import Wire, daemon_table, ready_daemon, request, until
from registry import threads

ROOT = Path(__file__).parents[2]
_COUNTED = tuple(f"{ROOT / name}/" for name in ("controller", "drivers", "model", "registry"))
_CLOCK = str(ROOT / "registry" / "virtual_time.py")  # of this run, and not of a daemon
_CALLBACK = str(Path("asyncio", "events.py"))  # what calls what the event loop runs
_BESIDE = tuple(f"{ROOT / name}/" for name in ("sim", "era_haptics/lab"))


def _is_counted(file: str) -> bool:
    """Whether a file belongs to the way that a daemon takes."""
    return file.startswith(_COUNTED) and file != _CLOCK


@dataclass
class Way:
    """Own functions in the order of their first calls, as (file, name), and the calls of files."""

    functions: dict[tuple[str, str], None] = field(default_factory=dict)
    calls: Counter[str] = field(default_factory=Counter)

    def called(self, code: types.CodeType) -> None:
        """Note a call."""
        file = Path(code.co_filename).relative_to(ROOT).as_posix()
        self.functions[file, code.co_qualname.partition(".<locals>")[0]] = None
        self.calls[file] += 1

    @property
    def files(self) -> list[str]:
        """The files on the way, in the order of their first calls."""
        return list(dict.fromkeys(file for file, _ in self.functions))


class Recorder:
    """Notes own calls while it is entered, anew each time, but those of far ends and judges."""

    def __init__(self) -> None:
        self._codes: list[types.CodeType] = []
        self._written = 0

    def __enter__(self) -> "Recorder":
        self._codes, self._written = [], 0
        sys.setprofile(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)

    def written(self) -> None:
        """Mark what was called until now."""
        self._written = len(self._codes)

    def way(self, *, is_until_written: bool = False) -> Way:
        """What was called, or what until the last mark."""
        way = Way()
        for code in self._codes[: self._written if is_until_written else None]:
            way.called(code)
        return way

    def _called(self, frame: types.FrameType, event: str, _: object) -> None:
        if event != "call" or not _is_counted(frame.f_code.co_filename):
            return
        outer: types.FrameType | None = frame
        while outer is not None and not outer.f_code.co_filename.endswith(_CALLBACK):
            if outer.f_code.co_filename.startswith(_BESIDE):
                return
            outer = outer.f_back
        self._codes.append(frame.f_code)


PAGE = ROOT / "docs" / "architecture.md"
WRITER = "tests/support/ways.py"
_RESTING, _COMING = Touch(1, 0.30, 0.55), Touch(2, 0.62, 0.40)


def touch() -> Way:
    """From a datagram with a further finger to the last byte of its set."""
    with TemporaryDirectory() as folder:
        return run_virtual(_touched(Path(folder)))


async def _touched(folder: Path) -> Way:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    received: list[Callable[..., None]] = []

    async def listen(host: str, port: int, given: Callable[..., None], **_: Any) -> Any:
        received.append(given)
        return types.SimpleNamespace(close=lambda: None)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(udp_source, "listen", listen)
        async with ready_daemon(folder, "touch: [{name: panel, url: 'tuio:'}]\n") as (bench, era):
            await era.arm("a test", lease_s=60)
            recorder, played = Recorder(), asyncio.Event()
            frames = 0

            def datagram(*fingers: Touch) -> tuple[bytes, tuple[str, int], float]:
                nonlocal frames
                frames, now = frames + 1, threads.now()
                frame = TouchFrame("panel@here", now, fingers)
                return tuio_datagram(frame, frames), ("127.0.0.1", 4000), now

            for _ in range(40):
                received[0](*datagram(_RESTING))
                await asyncio.sleep(0.05)
            seen = loop.seen

            def written(link: str, toward: str, data: bytes) -> None:
                if toward == "amplifier":
                    recorder.written()
                seen(link, toward, data)

            loop.seen = written

            def applied(_: object) -> None:
                loop.seen = seen
                played.set()

            bench.daemon._controller.cycle.observers.reported.append(applied)
            coming = datagram(_RESTING, _COMING)
            with recorder:
                loop.call_soon(received[0], *coming)
                await played.wait()
    return recorder.way(is_until_written=True)


class Scheduled:
    """The own functions that lead to the present one, over callbacks of the event loop."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._before: tuple[tuple[str, str], ...] = ()
        self._call_soon = loop.call_soon
        loop.call_soon = self._scheduled  # type: ignore[method-assign, assignment]

    def _scheduled(self, callback: Callable[..., Any], *args: Any, context: Any = None) -> Any:
        chain = self.here(sys._getframe(1))

        def run(*given: Any) -> None:
            self._before = chain
            callback(*given)
            self._before = ()

        return self._call_soon(run, *args, context=context)

    def here(self, frame: types.FrameType | None) -> tuple[tuple[str, str], ...]:
        """File and name of the functions on the way to a frame, outermost first."""
        found: list[tuple[str, str]] = []
        while frame is not None:
            code = frame.f_code
            if _is_counted(code.co_filename):
                file = Path(code.co_filename).relative_to(ROOT).as_posix()
                found.append((file, code.co_qualname))
            frame = frame.f_back
        return tuple(dict.fromkeys((*self._before, *reversed(found))))


def stop() -> Way:
    """From the bytes of a request to stop to those on the wire, and all own calls until then."""
    with TemporaryDirectory() as folder:
        return run_virtual(_stopped(Path(folder)))


async def _stopped(folder: Path) -> Way:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    async with ready_daemon(folder) as (bench, era):
        await era.arm("a test", lease_s=60)
        client, wire = Connection(bench.daemon._server), Wire()
        client.connection_made(wire)
        await asyncio.sleep(0.01)
        recorder, scheduled, seen = Recorder(), Scheduled(loop), loop.seen
        written = dict[tuple[str, str], None]()

        def first(*message: Any) -> None:
            loop.seen = seen
            recorder.written()
            written.update(dict.fromkeys(scheduled.here(sys._getframe(1))))
            seen(*message)

        loop.seen = first
        line = request("stop", id=1)
        client.get_buffer(len(line))[: len(line)] = line
        with recorder:
            client.buffer_updated(len(line))
            await until(lambda: wire.waiting)
        assert '"result"' in wire.waiting.decode(), wire.waiting
    return Way(written, recorder.way(is_until_written=True).calls)


def question() -> Way:
    """From `era_haptics.query` to its answer, with a quiet finger."""
    table = daemon_table()
    x, y = table.plate.length, table.plate.width
    ask = partial(query, table, (x / 3, y / 3), quiet=[(x / 2, y / 2)], drive_mode="phased")
    ask()  # what is prepared once
    with Recorder() as recorder:
        ask()
    return recorder.way()


def build() -> Way:
    """From a rig file to its table."""
    with Recorder() as recorder:
        build_table(load_rig(ROOT / "examples" / "paper_plate.yaml"))
    return recorder.way()


WAYS: dict[str, Callable[[], Way]] = {
    "touch": touch,
    "stop": stop,
    "question": question,
    "build": build,
}


def steps_of(name: str) -> list[tuple[str, str]]:
    """The steps of a way on the page, as (file, name): the rows above what is written for it."""
    above = PAGE.read_text("utf-8").partition(f"<!-- begin: written by {WRITER} {name} -->")[0]
    return re.findall(
        r"(?m)^\| [^|]+ \| `([\w/]+\.py)` `([\w.]+)` \|", above.rpartition("\n## ")[2]
    )


def beside(name: str) -> str:
    """What the page says below the steps of a way: its other files."""
    way = WAYS[name]()
    steps = {file for file, _ in steps_of(name)}
    others = ", ".join(f"`{file}`" for file in way.files if file not in steps)
    return f"Also on this way: {others}." if others else "No other file is on this way."


PARTS = {name: partial(beside, name) for name in WAYS}
"""What is written on the page, by the name of its part."""

if __name__ == "__main__":
    for name in sys.argv[1:] or WAYS:
        found = WAYS[name]()
        lines = [f"{file} {function}" for file, function in found.functions]
        count = f"{found.calls.total()} calls, {len(found.functions)} functions"
        sys.stdout.write("\n".join([*lines, f"{name}: {count}, {len(found.files)} files\n\n"]))
