"""An armed group of amplifiers on lines of protocol 3 in virtual time."""

import functools
import inspect
from collections.abc import Awaitable, Callable
from typing import Any

from drivers.contents import Layer, Tone
from drivers.host.group import Group
from virtual_loop import run_virtual
from words_line import Alter, MemoryLine, unaltered


def tone(channel: int = 0, level: float = 0.5, **other: object) -> Tone:
    """A tone of 100 Hz at half level unless told otherwise."""
    return Tone(channel, 100.0, level, **other)  # type: ignore[arg-type]


def layer(number: int, *tones: Tone, **other: object) -> Layer:
    """A layer with a ramp of 1 ms."""
    return Layer(number, tones, 0.001, **other)  # type: ignore[arg-type]


def with_group(
    test: Callable[[Group, list[MemoryLine]], Awaitable[None]], wire: str, *lines: tuple[str, ...]
) -> None:
    """Run a test with an armed group of amplifiers, by their names on each line of a kind."""

    async def run() -> None:
        ends = [MemoryLine(wire, *names) for names in lines]
        hosts = {name: host for end in ends for name, host in end.hosts.items()}
        group = Group(hosts, draw=lambda low, high: 77)
        await group.open()
        await group.arm()
        await test(group, ends)

    run_virtual(run())


def grouped(*lines: tuple[str, ...], wire: str = "") -> Callable[[Callable[..., Any]], Any]:
    """Run a test with an armed group and the lines that it is on: `with_group` as a decorator.

    wire: the kind of all lines, else the argument or fixture of that name.
    """

    def decorate(test: Callable[..., Any]) -> Callable[..., None]:
        given = [*inspect.signature(test).parameters.values()][2:]
        own = [each.name for each in given]
        if not wire and "wire" not in own:
            given.append(inspect.Parameter("wire", inspect.Parameter.KEYWORD_ONLY))

        @functools.wraps(test)
        def run(**arguments: Any) -> None:
            passed = {name: arguments[name] for name in own}
            kind = wire or arguments["wire"]
            with_group(lambda group, ends: test(group, ends, **passed), kind, *lines)

        run.__signature__ = inspect.Signature(given)  # type: ignore[attr-defined]
        return run

    return decorate


def losing(*names: str, count: int = 1) -> Alter:
    """Loses so many frames of these messages, in whichever direction."""
    left = count

    def alter(name: str, data: bytes) -> list[tuple[float, bytes]]:
        nonlocal left
        if name in names and left > 0:
            left -= 1
            return []
        return unaltered(name, data)

    return alter
