"""Turns of the API's clients, by counting requests, in virtual time."""

import asyncio

import pytest

from controller.api import connection
from daemons import ServedApi, feed, request
from virtual_lines import in_virtual_time

REQUEST = request("renew", '{"lease":"a"}')
TOUCH = request("touch", '{"source":"a","touches":[]}', id=1)
TOUCH_DOWN = TOUCH.replace(b"[]", b'[{"id":1,"x_m":0.1,"y_m":0.1}]')
LOOKALIKE = request("renew", '{"lease":"stop"}')
STOP = request("stop")


def serve(**costs: float) -> ServedApi:
    """A server that counts time from now on; costs: as for `ServedApi`."""
    loop = asyncio.get_running_loop()
    began_at = loop.time()
    return ServedApi(clock=lambda: loop.time() - began_at, **costs)


@pytest.fixture(autouse=True)
def one_line_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    """End turns by the number of lines, as virtual time stands still meanwhile."""
    monkeypatch.setattr(connection, "MAX_TURN", 0.0)


@in_virtual_time
async def test_turn_ends_with_the_line_after_a_tenth_of_a_millisecond(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whose lines take 30 us each: four of ten."""
    lines = 0

    def count(name: str) -> None:
        nonlocal lines
        lines += 1

    monkeypatch.undo()
    monkeypatch.setattr(connection.time, "perf_counter", lambda: 30e-6 * lines)
    served = serve()
    served.called = count
    feed(served.client()[0], REQUEST * 10)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert lines == 4


@in_virtual_time
async def test_clients_take_a_burst_then_a_quarter_of_the_time() -> None:
    """Of requests of 1 ms each: 20 at once, then 250 in a second, each overdrawn by at most one."""
    served = serve(costs=0.001)
    client, _ = served.client()
    feed(client, TOUCH * 700)
    await asyncio.sleep(1.0)
    times = served.times("touch")
    assert sum(time == 0 for time in times) == pytest.approx(20, abs=1)
    assert len(times) == pytest.approx(20 + 250, abs=3)


@in_virtual_time
async def test_client_that_touches_waits_for_no_other_client() -> None:
    """Beside 30 that ask without end, whose requests of 1 ms each take all of their own share."""
    served = serve(costs=0.001)
    touching, _ = served.client()
    feed(touching, TOUCH_DOWN)
    for _ in range(30):
        feed(served.client()[0], REQUEST * 100)
    for number in range(1, 6):
        await asyncio.sleep(0.1 * number - served.clock())
        feed(touching, TOUCH_DOWN)
    await asyncio.sleep(0.05)
    assert len(served.times("renew")) < 250
    assert served.times("touch") == pytest.approx([0, 0.1, 0.2, 0.3, 0.4, 0.5], abs=0.002)


@in_virtual_time
async def test_client_whose_fingers_were_never_lifted_is_one_of_the_others() -> None:
    """150 ms after its last frame, as its contacts: it and the others have one share."""
    served = serve(costs=0.001)
    silent, _ = served.client()
    feed(silent, TOUCH_DOWN)
    feed(served.client()[0], REQUEST * 400)
    await asyncio.sleep(0.3)
    feed(silent, REQUEST * 400)
    await asyncio.sleep(1.0 - served.clock())
    assert len(served.calls) == pytest.approx(1 + 20 + 250, abs=3)


@in_virtual_time
async def test_requests_wait_while_a_touch_is_on_its_way_to_the_wire() -> None:
    """Until it is sent, and for 3 ms at most if touches follow each other without a gap."""
    served = serve()
    client, _ = served.client()
    served.is_busy = True
    feed(client, REQUEST * 4)
    await asyncio.sleep(0.0029)
    assert served.calls == []
    await asyncio.sleep(0.0049)
    assert served.times("renew") == pytest.approx([0.003, 0.0065], abs=0.001)
    served.is_busy = False
    await asyncio.sleep(0.0006)
    assert len(served.times("renew")) == 4


@in_virtual_time
async def test_a_turn_that_is_deferred_costs_its_clients_nothing() -> None:
    """Else what was saved until it is due may be spent by finding that it is not due yet."""
    served = serve(costs=0.015, reading_costs=3e-6)
    client, _ = served.client()
    feed(client, REQUEST * 3)
    await asyncio.sleep(0.1)
    assert served.times("renew") == pytest.approx([0.0, 0.0, 0.04], abs=0.001)


@in_virtual_time
async def test_stop_is_served_at_once_though_touches_come_first_and_time_is_overdrawn() -> None:
    """Also behind other requests of its client, and in two parts."""
    served = serve(costs=0.001)
    client, _ = served.client()
    feed(client, TOUCH * 100)
    await asyncio.sleep(0.01)
    assert len(served.times("touch")) < 30
    served.is_busy = True
    feed(client, STOP[:-5])
    feed(client, STOP[-5:])
    await asyncio.sleep(0.001)
    assert served.times("stop") == [pytest.approx(0.01)]
    assert len(served.times("touch")) == 100


@in_virtual_time
async def test_lines_that_only_look_like_a_stop_are_served_in_turn() -> None:
    """The first of them is served at once, the next one so only a tenth of a second later."""
    served = serve()
    client, _ = served.client()
    served.is_busy = True
    for pause in (0.0, 0.001, 0.05, 0.06):
        await asyncio.sleep(pause)
        feed(client, LOOKALIKE)
        for _ in range(4):
            await asyncio.sleep(0)
    delays = [
        time - sent
        for time, sent in zip(served.times("renew"), (0.0, 0.001, 0.051, 0.111), strict=True)
    ]
    assert delays == pytest.approx([0.0, 0.003, 0.003, 0.0], abs=0.0006)
