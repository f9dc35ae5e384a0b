"""Tasks that go on together."""

import asyncio

import pytest

from controller.group.joint_start import JointStart


async def test_last_one_goes_on_at_once() -> None:
    """It has begun and gone on before the event loop runs the others."""
    order: list[str] = []
    start = JointStart(3, lambda: not order.append("begun"))

    async def one(name: str) -> None:
        assert await start.ready()
        order.append(name)

    others = [asyncio.create_task(one(name)) for name in ("first", "second")]
    await asyncio.sleep(0)
    assert order == []
    await one("last")
    assert order == ["begun", "last"]
    await asyncio.gather(*others)
    assert order == ["begun", "last", "first", "second"]


@pytest.mark.parametrize("fails_last", [False, True])
async def test_none_goes_on_if_one_fails(fails_last: bool) -> None:
    """Nothing begins either, and the others wait until all are ready or have failed."""
    called: list[bool] = []
    start = JointStart(3, lambda: not called.append(True))
    if not fails_last:
        start.fail()
    waiting = [asyncio.create_task(start.ready()) for _ in range(2 if fails_last else 1)]
    await asyncio.sleep(0)
    assert not any(task.done() for task in waiting)
    if fails_last:
        start.fail()
    else:
        assert not await start.ready()
    assert await asyncio.gather(*waiting) == [False] * len(waiting)
    assert called == []


async def test_none_goes_on_if_beginning_fails() -> None:
    """The last one raises the error; the others do not wait for ever."""

    def failing() -> bool:
        raise ZeroDivisionError

    start = JointStart(2, failing)
    other = asyncio.create_task(start.ready())
    await asyncio.sleep(0)
    with pytest.raises(ZeroDivisionError):
        await start.ready()
    assert not await other
