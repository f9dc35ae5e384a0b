"""Tables and answers for fingers, and TUIO as a sender makes it, by python-osc.

Captures of it, and a panel of a daemon.
"""

import asyncio
import socket
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from controller.play.shared_capabilities import RAMPS_ONLY, PlaybackCapabilities
from controller.sources.touch import Touch, TouchFrame
from controller.sources.tuio_capture import RecordedDatagram
from examples.make_touches import tuio_datagram, write_capture
from kit.plates import smooth_rig
from model.answer.answer import Limits
from model.table.table import LocalizationTable
from model.table.table_file import build_table


def answers_take(patch: pytest.MonkeyPatch, *seconds: float) -> list[float]:
    """Let answers of the thread take these times [s], the last one from then on.

    Returns when [s] each was asked for.
    """
    times: list[float] = []

    def answer_late(loop: Any, executor: Any, work: Callable[[], Any]) -> "asyncio.Future[Any]":
        future = loop.create_future()
        number = min(len(times), len(seconds) - 1)
        loop.call_later(seconds[number], lambda: future.set_result(work()))
        times.append(loop.time())
        return future

    patch.setattr(type(asyncio.get_running_loop()), "run_in_executor", answer_late)
    return times


@cache
def table() -> LocalizationTable:
    """The paper's plate at 29 frequencies."""
    return build_table(smooth_rig(), frequencies=np.linspace(40.0, 320.0, 29))


def playable(layers: int = 8) -> PlaybackCapabilities:
    """What amplifiers of that plate can play, of so many layers, with ramps alone."""
    return PlaybackCapabilities(
        "phased",
        ("phased",),
        Limits((40.0, 320.0), table().full_levels),
        RAMPS_ONLY,
        layers=layers,
    )


def message(*arguments: Any, address: str = "/tuio/2Dcur") -> Any:
    """An OSC message with python-osc's own choice of types."""
    builder = OscMessageBuilder(address)
    for argument in arguments:
        builder.add_arg(argument)
    return builder.build()


def bundle(*messages: Any) -> bytes:
    """A bundle as a TUIO sender makes it."""
    builder = OscBundleBuilder(IMMEDIATELY)
    for part in messages:
        builder.add_content(part)
    return builder.build().dgram


def cursor(id: int, x: float, y: float) -> Any:
    """A set message of a cursor at rest."""
    return message("set", id, x, y, 0.0, 0.0, 0.0)


def frame(*touches: tuple[int, float, float], fseq: int = -1, source: str = "table@a") -> bytes:
    """A complete bundle."""
    return bundle(
        message("source", source),
        message("alive", *(id for id, _, _ in touches)),
        *(cursor(*touch) for touch in touches),
        message("fseq", fseq),
    )


def free_port() -> int:
    """Find a free UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def panel(port: int) -> str:
    """The lines of a daemon's file for a TUIO panel."""
    return f'touch: [{{name: panel, url: "tuio:127.0.0.1:{port}?timeout=0.15"}}]\n'


FRAME = 1 / 50  # s


def write_schedule(
    path: Path, schedule: Sequence[tuple[int, float, float, float, float]], seconds: float
) -> Path:
    """Write a TUIO capture of fingers: id, down and up [s], place in TUIO's coordinates."""
    datagrams = []
    for number in range(round(seconds / FRAME)):
        now = number * FRAME
        touches = tuple(Touch(id, x, y) for id, down, up, x, y in schedule if down <= now < up)
        frame = TouchFrame("test", now, touches)
        datagrams.append(RecordedDatagram(now, tuio_datagram(frame, number + 1)))
    write_capture(path, datagrams)
    return path
