"""The whole chain in processes of its own: touches over UDP, daemon, wire, far end, fingertips.

The daemon has only the URL of its amplifier. Nothing depends on how fast the machine is: each step
waits for what the one before has led to.
"""

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from controller.api.client_protocol import Notification
from controller.sources.tuio import tuio_datagram
from daemon_bench import until
from far_end_process import far_end_process
from felt_chain import Played
from heard import PATIENCE, SENSORS, Control, Heard, hear
from rig_files import write_rig
from stream_daemon import RunningDaemon, running_daemon
from touch_stream import FRAME, Situation, Stream

_SETTLED = 0.7  # s; of a pattern, or of silence, before it is measured


@dataclass
class Chain:
    """Daemon, wire and far end, ready to be armed."""

    daemon: RunningDaemon
    control: Control
    _events: list[Notification] = field(default_factory=list)

    async def play(self, stream: Stream) -> tuple[Played, int]:
        """Play the situations of a stream and end the daemon; also returns its exit status."""
        sensors = {name: {"at_m": list(at)} for name, at in SENSORS.items()}
        await self.control.ask("sensors", sensors=sensors)
        await self._touch(stream, {})
        await self.daemon.client.subscribe("pattern")
        listening = asyncio.create_task(self._listen())
        async with self.daemon.client.armed("test", lease_s=60):
            heard = [await self._situation(stream, each) for each in stream.situations]
        listening.cancel()
        state = await self.control.ask("state")
        status = await self.daemon.end()
        return Played(heard, [], [], 0, state), status

    async def _situation(self, stream: Stream, situation: Situation) -> Heard:
        """Put the fingers down, wait until they feel it steadily, and read what they felt."""
        await self._touch(stream, situation.fingers)
        begin = time.monotonic()
        sending = asyncio.create_task(self._send(stream, situation.fingers))
        try:
            if situation.fingers:
                await until(
                    lambda: self._events and self._events[-1].time >= begin, patience=PATIENCE
                )
            else:
                await self._silence()
            await asyncio.sleep(_SETTLED)
            end = time.monotonic()
            return await hear(self.control, situation, begin, end, events=self._events)
        finally:
            sending.cancel()

    async def _send(self, stream: Stream, fingers: Mapping[int, str]) -> None:
        """Send a frame again and again, as touch tables do."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            number = round(time.monotonic() / FRAME)
            while True:
                number += 1
                datagram = tuio_datagram(stream.frame(time.monotonic(), fingers), number)
                sender.sendto(datagram, ("127.0.0.1", self.daemon.port))
                await asyncio.sleep(FRAME)

    async def _touch(self, stream: Stream, fingers: Mapping[int, str]) -> None:
        """Rest fingers on places; at the others they only feel."""
        await self.control.ask(
            "fingers",
            fingers={name: list(at) for name, at in stream.places.items()},
            observers=[name for name in stream.places if name not in fingers.values()],
        )

    async def _silence(self) -> None:
        """Wait until no amplifier plays."""
        is_silent = False
        async with asyncio.timeout(PATIENCE):
            while not is_silent:
                state = await self.control.ask("state")
                is_silent = not any(state["amplifiers"]["main"]["levels"])

    async def _listen(self) -> None:
        async for notification in self.daemon.client.events():
            self._events.append(notification)


@asynccontextmanager
async def running_chain(folder: Path, wire: str, *, table: Path) -> AsyncIterator[Chain]:
    """A daemon over a wire of this kind and the far end; "sim": within the daemon."""
    truth = write_rig(folder / "truth.yaml")
    async with contextlib.AsyncExitStack() as stack:
        path = folder / "plate"
        if wire == "sim":
            url = f"sim://{quote(str(truth))}?control={quote(str(path))}"
        else:
            far_end = await stack.enter_async_context(
                far_end_process(truth, "--wire", f"main={wire}")
            )
            path = far_end.control
            url = far_end.urls["main"]
        daemon = await stack.enter_async_context(running_daemon(folder, url, table=table))
        await stack.enter_async_context(daemon.client)
        control = await stack.enter_async_context(Control.at(path))
        yield Chain(daemon, control)
