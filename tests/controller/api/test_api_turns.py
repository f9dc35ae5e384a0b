"""Turns of the API's clients, by counting requests, in virtual time."""

import asyncio
from collections.abc import Callable

import pytest

from controller.api import turns
from controller.api.connection import Connection
from controller.api.methods import METHODS
from controller.api.schema import Message
from controller.api.server import ApiServer
from virtual_loop import in_virtual_time
from wire_of_memory import Wire

REQUEST = b'{"jsonrpc":"2.0","method":"renew","params":{"lease":"a"}}\n'
TOUCH = b'{"jsonrpc":"2.0","method":"touch","params":{"source":"a","touches":[]},"id":1}\n'
TOUCH_DOWN = TOUCH.replace(b"[]", b'[{"id":1,"x_m":0.1,"y_m":0.1}]')
LOOKALIKE = b'{"jsonrpc":"2.0","method":"renew","params":{"lease":"stop"}}\n'
STOP = b'{"jsonrpc":"2.0","method":"stop"}\n'


class Served:
    """A server whose methods take a processor time [s] each; is_busy: of touches."""

    def __init__(self, *, costs: float = 0.0) -> None:
        self.is_busy = False
        self.times: dict[str, list[float]] = {}
        self._processor_time = 0.0
        self._loop = asyncio.get_running_loop()

        def handler(name: str) -> Callable[[Connection, Message], Message]:
            def handle(client: Connection, params: Message) -> Message:
                self._processor_time += costs
                self.times.setdefault(name, []).append(self.now)
                return METHODS[name].result.model_construct()

            return handle

        self._server = ApiServer(
            {name: handler(name) for name in METHODS},
            on_disconnect=lambda client: None,
            holds_lease=lambda client: False,
            is_subscribed=lambda client: False,
            is_busy=lambda: self.is_busy,
            clock=self._loop.time,
            processor_time=lambda: self._processor_time,
        )
        self.began_at = self._loop.time()
        self._clients: dict[int, Connection] = {}

    @property
    def now(self) -> float:
        """Time since it began [s]."""
        return self._loop.time() - self.began_at

    def receive(self, data: bytes, *, client: int = 1) -> None:
        """Receive bytes of a client."""
        if client not in self._clients:
            self._clients[client] = self._server._make_connection(client)
            self._clients[client].connection_made(Wire())
        self._clients[client].data_received(data)


@in_virtual_time
async def test_clients_take_a_burst_then_a_quarter_of_the_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of requests of 1 ms each: 20 at once, then 250 in a second, each overdrawn by at most one."""
    monkeypatch.setattr(turns, "MAX_TURN", 0.0)  # a line per turn
    served = Served(costs=0.001)
    served.receive(TOUCH * 700)
    await asyncio.sleep(1.0)
    times = served.times["touch"]
    assert sum(time == 0 for time in times) == pytest.approx(20, abs=1)
    assert len(times) == pytest.approx(20 + 250, abs=3)


@in_virtual_time
async def test_client_that_touches_waits_for_no_other_client() -> None:
    """Beside 30 that ask without end, whose requests of 1 ms each take all of their own share."""
    served = Served(costs=0.001)
    served.receive(TOUCH_DOWN, client=0)
    for client in range(1, 31):
        served.receive(REQUEST * 100, client=client)
    for number in range(1, 6):
        await asyncio.sleep(0.1 * number - served.now)
        served.receive(TOUCH_DOWN, client=0)
    await asyncio.sleep(0.05)
    assert len(served.times["renew"]) < 250
    assert served.times["touch"] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5], abs=0.002)


@in_virtual_time
async def test_requests_wait_while_a_touch_is_on_its_way_to_the_wire(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Until it is sent, and for 3 ms at most if touches follow each other without a gap."""
    monkeypatch.setattr(turns, "MAX_TURN", 0.0)  # a line per turn
    served = Served()
    served.is_busy = True
    served.receive(REQUEST * 4)
    await asyncio.sleep(0.0029)
    assert served.times == {}
    await asyncio.sleep(0.0049)
    assert served.times["renew"] == pytest.approx([0.003, 0.0065], abs=0.001)
    served.is_busy = False
    await asyncio.sleep(0.0006)
    assert len(served.times["renew"]) == 4


@in_virtual_time
async def test_stop_is_served_at_once_though_touches_come_first_and_time_is_overdrawn() -> None:
    """Also behind other requests of its client, and in two parts."""
    served = Served(costs=0.001)
    served.receive(TOUCH * 100)
    await asyncio.sleep(0.01)
    assert len(served.times["touch"]) < 30
    served.is_busy = True
    served.receive(STOP[:-5])
    served.receive(STOP[-5:])
    await asyncio.sleep(0.001)
    assert served.times["stop"] == [pytest.approx(0.01)]
    assert len(served.times["touch"]) == 100


@in_virtual_time
async def test_lines_that_only_look_like_a_stop_are_served_in_turn() -> None:
    """The first of them is served at once, the next one so only a tenth of a second later."""
    served = Served()
    served.is_busy = True
    for pause in (0.0, 0.001, 0.05, 0.06):
        await asyncio.sleep(pause)
        served.receive(LOOKALIKE)
        for _ in range(4):
            await asyncio.sleep(0)
    delays = [
        time - sent
        for time, sent in zip(served.times["renew"], (0.0, 0.001, 0.051, 0.111), strict=True)
    ]
    assert delays == pytest.approx([0.0, 0.003, 0.003, 0.0], abs=0.0006)
