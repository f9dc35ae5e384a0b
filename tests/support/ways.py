"""The ways of a touch, a stop, a question and a build through the project's own files.

    python tests/support/ways.py

A daemon in memory, armed, has a finger that rests; another comes by a TUIO datagram. Its way: all
that is called until the last byte of its set is written, far ends and judges left out, in virtual
time. The stop: what leads from the bytes of the request to those on the wire. A question is asked
and a table built by the public functions.
"""

import asyncio
import re
import sys
import types
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from controller.sources import udp_source
from controller.sources.touch import Touch, TouchFrame
from courses import ROOT, Recorder, Way
from daemons import daemon_table, ready_daemon
from era_haptics import query
from examples.make_touches import tuio_datagram
from model.rig.rig_file import load_rig
from model.table.table_file import build_table
from registry import threads
from stop_path import stop_path
from virtual_lines import VirtualLoop, run_virtual

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


def stop() -> Way:
    """From the bytes of a request to stop to those on the wire; each function counts once."""
    functions, _ = stop_path()
    return Way(dict.fromkeys(functions), Counter(file for file, _ in functions))


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
