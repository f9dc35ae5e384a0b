"""The applications of the examples on a real daemon: the page in a browser, and the program."""

import asyncio
import os
import signal
import subprocess
import sys
import threading
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from controller.api.client import Client
from controller.api.methods import StateEvent, TouchParams
from processes.daemons import PATIENCE
from processes.gateways import (
    TOKEN,
    Page,
    ScriptedDaemon,
    gateway_process,
    open_browser,
    real_daemon,
    wait_for,
    wait_for_state,
)

FOLDER = Path(__file__).parents[2] / "examples" / "application"
GATEWAY = "http://127.0.0.1:8137/"
SAID = "document.querySelector('#state').textContent"
FELT = "document.querySelector('#felt').textContent"


class Network:
    """Between browser and gateway: passes bytes on, or refuses connections while it is cut."""

    def __init__(self) -> None:
        self.port = self.target = 0  # target: port of the gateway
        self.is_cut = False
        self._writers: set[asyncio.StreamWriter] = set()

    @asynccontextmanager
    async def serving(self) -> AsyncIterator["Network"]:
        """Accept connections on a free port."""
        async with await asyncio.start_server(self._accept, "127.0.0.1", 0) as server:
            self.port = server.sockets[0].getsockname()[1]
            yield self
            self.cut()

    def cut(self) -> None:
        """Close all connections and refuse others."""
        self.is_cut = True
        for writer in self._writers:
            writer.transport.abort()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        with suppress(OSError):
            if not self.is_cut:
                back, forth = await asyncio.open_connection("127.0.0.1", self.target)
                self._writers.add(forth)
                await asyncio.gather(self._pass(reader, forth), self._pass(back, writer))
        writer.transport.abort()

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(1 << 16):
            writer.write(data)
        writer.close()


@asynccontextmanager
async def shown(tmp_path: Path) -> AsyncIterator[tuple[Page, Network, ExitStack, str]]:
    """A tab, the network, what ends at the end, and the origin of the page.

    The example's page comes from a server that is not the gateway but names it.
    """
    text = (FOLDER / "plate.html").read_text(encoding="utf-8")
    assert text.count(GATEWAY) == 1
    folder = tmp_path / "page"
    folder.mkdir()
    handler = partial(SimpleHTTPRequestHandler, directory=str(folder))
    async with (
        Network().serving() as network,
        open_browser(tmp_path / "profile") as browser,
        browser.open_page() as tab,
    ):
        page_text = text.replace(GATEWAY, f"http://127.0.0.1:{network.port}/")
        (folder / "plate.html").write_text(page_text, encoding="utf-8")
        with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, ExitStack() as ended:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            ended.callback(server.shutdown)
            yield tab, network, ended, f"http://127.0.0.1:{server.server_port}"


def url(origin: str) -> str:
    """The page's address; it takes no gateway from a link."""
    return f"{origin}/plate.html?gateway=http://127.0.0.1:1/#{TOKEN}"


@pytest.mark.long
@pytest.mark.real_time
async def test_page_plays_and_comes_back_after_every_loss(tmp_path: Path) -> None:
    """Armed and touched over a cut network; after a new daemon and gateway it follows, disarmed,
    and says that its lease was lost.
    """
    async with shown(tmp_path) as (tab, network, ended, origin):

        async def until_said(start: str) -> None:
            await tab.until(SAID, lambda text: text.startswith(start))

        with gateway_process(tmp_path, tmp_path / "era.sock", "--allow-origin", origin) as gateway:
            network.target = gateway.port
            with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
                wait_for_state(era, "READY_TO_SWITCH_ON")
                await tab.show(url(origin))
                await until_said("ready: ")
                await tab.click("#arm")
                await until_said("on: armed by 'my application'")
                x, y, width, height = await tab.evaluate(
                    "(({x, y, width, height}) => [x, y, width, height])"
                    "(document.querySelector('#plate').getBoundingClientRect())"
                )
                await tab.touch("touchStart", [(x + width / 4, y + height / 2)])
                await tab.until(FELT, lambda text: text.startswith("played by "))
                rig = era.hello("test").rig
                # what is felt may have expired on a busy machine, until the page repeats it
                (contact,) = await asyncio.to_thread(wait_for, lambda: era.status().contacts)
                assert contact.x_m == pytest.approx(rig.length_m / 4, abs=2e-3)
                assert contact.y_m == pytest.approx(rig.width_m / 2, abs=2e-3)
                network.cut()
                await until_said("no connection: ")
                network.is_cut = False
                await until_said("on: armed by 'my application'")
                await asyncio.to_thread(wait_for, lambda: (era.status().lease_left_s or 0) < 4.2)
                await asyncio.to_thread(wait_for, lambda: (era.status().lease_left_s or 0) > 4.5)
                await asyncio.to_thread(wait_for, lambda: len(era.status().contacts) == 1)
            await until_said("no connection: daemon")
            with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
                await until_said("ready: ")
                await asyncio.to_thread(wait_for, lambda: len(era.status().contacts) == 1)
                await tab.until(FELT, lambda text: "lease" in text)
                assert era.status().armed_by is None
                gateway.terminate()
                await until_said("no connection: unreachable")
                again = ("--allow-origin", origin, "--listen", f"127.0.0.1:{gateway.port}")
                ended.enter_context(gateway_process(tmp_path, socket, *again))
                await until_said("ready: ")
                await tab.touch("touchEnd", [])
                await asyncio.to_thread(wait_for, lambda: not era.status().contacts)


@pytest.mark.real_time
def test_program_holds_fingers_and_prints_what_plays(tmp_path: Path) -> None:
    """It arms, plays and leaves the daemon disarmed."""
    with real_daemon(tmp_path) as socket, Client.connect(socket) as era:
        wait_for_state(era, "READY_TO_SWITCH_ON")
        done = subprocess.run(
            [sys.executable, FOLDER / "follow.py", "0.22,0.16", "0.08,0.06"],
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "ERA_HAPTICS_SOCKET": str(socket)},
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert "on: armed by 'follow'\n" in done.stdout
        assert "played by " in done.stdout
        assert era.status().state == "READY_TO_SWITCH_ON"
        assert not era.status().contacts


@pytest.mark.real_time
async def test_page_leaves_a_silent_network_and_repeats_no_arm(tmp_path: Path) -> None:
    """A pending arm is given up with the connection; the page subscribes anew.

    Its stop needs nothing that old browsers lack: without AbortSignal.timeout it goes both ways;
    where HTTP throws, over the WebSocket.
    """
    async with shown(tmp_path) as (tab, network, ended, origin):
        daemon = ended.enter_context(ScriptedDaemon(tmp_path))
        options = ("--allow-origin", origin)
        gateway = ended.enter_context(gateway_process(tmp_path, daemon.socket, *options))
        network.target = gateway.port
        await tab.show(url(origin))
        await tab.until(SAID, lambda text: text.startswith("ready: "))
        with daemon.holding():
            await tab.click("#arm")
            await asyncio.to_thread(wait_for, lambda: "arm" in daemon.methods)
            gateway.process.send_signal(signal.SIGSTOP)  # nothing comes, and nothing closes
            async with asyncio.timeout(PATIENCE / 6):
                await tab.until(SAID, lambda text: "gateway" in text or "no connection" in text)
            gateway.process.send_signal(signal.SIGCONT)
            await tab.until(SAID, lambda text: text.startswith("ready: "))
        cut = StateEvent(
            old="READY_TO_SWITCH_ON", new="FAULT", cause="a cable was cut", remedy=None, epoch=1
        )
        daemon.publish("state", cut)
        await tab.until(f"{SAID} === 'fault: a cable was cut'")
        assert daemon.methods.count("arm") == 1
        await tab.evaluate("delete AbortSignal.timeout")
        await tab.click("#stop")
        await asyncio.to_thread(wait_for, lambda: daemon.methods.count("stop") == 2)
        await tab.evaluate("window.fetch = () => { throw new Error('none'); }; undefined")
        await tab.click("#stop")
        await asyncio.to_thread(wait_for, lambda: daemon.methods.count("stop") == 3)


@pytest.mark.real_time
async def test_page_that_loses_its_user_lifts_and_disarms(tmp_path: Path) -> None:
    """Fingers are lifted when the page is hidden; it disarms when it is closed or left.

    A connection that has lost its WebSocket disarms over HTTP. The page's clock stands still, so
    that no lease runs out on a busy machine.
    """
    async with shown(tmp_path) as (tab, network, ended, origin):
        daemon = ended.enter_context(ScriptedDaemon(tmp_path))
        options = ("--allow-origin", origin)
        gateway = ended.enter_context(gateway_process(tmp_path, daemon.socket, *options))
        network.target = gateway.port
        connect_and_arm = (
            "(async () => {"
            f"  const {{ Connection }} = await import('http://127.0.0.1:{network.port}/connection.js');"
            "  await new Promise((opened) => {"
            f"    window.own = new Connection('{TOKEN}', ['state'], {{ opened }}); }});"
            "  await own.arm('own');"
            "})()"
        )

        async def show_page() -> None:
            await tab.show(url(origin))
            await tab.until(SAID, lambda text: text.startswith("ready: "))
            await tab.evaluate("performance.now = () => 0; undefined")

        async def until_called(method: str, count: int) -> None:
            await asyncio.to_thread(wait_for, lambda: daemon.methods.count(method) == count)

        def fingers() -> list[int]:
            """How many fingers each report so far has had."""
            return [
                len(params.touches) for _, params in daemon.calls if isinstance(params, TouchParams)
            ]

        endings = ("own.socket.close(); own.disarm()", "own.close()")
        for count, ending in enumerate(endings, start=1):
            await show_page()
            await tab.evaluate(connect_and_arm)
            assert (await tab.evaluate("own.layout('home')"))["layout"] == "home"
            await tab.evaluate(ending)
            await until_called("disarm", count)
        await tab.until("own.socket.readyState === WebSocket.CLOSED")
        await tab.click("#arm")
        await until_called("arm", 3)
        x, y = await tab.evaluate(
            "(({x, y}) => [x + 50, y + 50])"
            "(document.querySelector('#plate').getBoundingClientRect())"
        )
        await tab.touch("touchStart", [(x, y)])
        await asyncio.to_thread(wait_for, lambda: 1 in fingers())
        await tab.evaluate(
            "Object.defineProperty(document, 'hidden', { value: true });"
            "document.dispatchEvent(new Event('visibilitychange'))"
        )
        await asyncio.to_thread(wait_for, lambda: fingers()[-1] == 0)
        assert daemon.methods.count("disarm") == 2
        await tab.call("Page.navigate", url="about:blank")
        await until_called("disarm", 3)
