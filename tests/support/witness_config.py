"""A witness of amplifiers by their URLs, and of a control loop in virtual time."""

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from typing import Any, get_args

from controller.loop.loop import Controller
from drivers import clock
from sim.amplifier.contract import Amplifier
from sim.witness.witness import OperatorCommand, Witness
from sim.witness_relay import parse_endpoint
from virtual_loop import VirtualLoop


def witness_config(
    urls: Mapping[str, str],
    *,
    channels: int = 4,
    times_s: Mapping[str, float] | None = None,
    **limits: Any,
) -> dict[str, Any]:
    """A configuration with wires named by their location; limits: of all channels."""
    endpoints = {name: parse_endpoint(url) for name, url in urls.items()}
    limits = {"frequency_hz": [40, 500], "level": 1.0} | limits
    return {
        "wires": {endpoint.location: endpoint.kind for endpoint in endpoints.values()},
        "amplifiers": {
            name: {
                "wire": endpoint.location,
                "address": endpoint.address,
                "channels": dict.fromkeys(range(channels), limits),
            }
            for name, endpoint in endpoints.items()
        },
        "times_s": times_s or {},
    }


def sense(witness: Witness, now: float, name: str, amplifier: Amplifier) -> None:
    """Show the levels and frequencies of an amplifier's channels at a time [s]."""
    channels = range(amplifier.playback.channels)
    levels = [min(amplifier.playback.level(channel, now), 1.0) for channel in channels]
    frequencies = {
        channel: tone.frequency
        for channel, output in enumerate(amplifier.outputs)
        for tone in output
        if tone.transition.last
    }
    witness.levels(now, name, levels, frequencies=frequencies)


class LoopWitness(Witness):
    """A witness of all wires of a control loop, in virtual time, by the URLs of its amplifiers.

    judged: by what it judges, as for `witness_config`.
    """

    def __init__(self, urls: Mapping[str, str], **judged: Any) -> None:
        super().__init__(witness_config(urls, **judged))
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.loop = loop
        loop.seen = self.seen

    def seen(self, link: str, toward: str, data: bytes) -> None:
        """Hear bytes."""
        self.record_bytes(link, toward, clock.now(), data)  # type: ignore[arg-type]

    def follow(self, controller: Controller) -> None:
        """Hear of each command, opening and closing of a control loop."""
        for command in get_args(OperatorCommand):
            tell_first(controller, command, partial(self.commanded, command))
        tell_first(controller, "open", self.opens)
        controller.release = partial(self._released, controller.release)  # type: ignore[method-assign]

    def commanded(self, command: OperatorCommand) -> None:
        """An operator's command is about to be carried out."""
        self.operator_command(clock.now(), command)

    def opens(self) -> None:
        """A host is about to open all wires."""
        for link in self.wires:
            self.opened(link, clock.now())

    def closes(self) -> None:
        """The host has closed all, or died."""
        for link in self.wires:
            self.closed(link, clock.now())

    async def _released(self, release: Callable[[], Awaitable[None]]) -> None:
        try:
            await release()
        finally:
            self.closes()

    def disturb(self, *, are_on: bool = True) -> None:
        """Faults begin or end; one wire's may show on each."""
        for link in self.wires:
            self.faults(clock.now(), link, are_on=are_on)


def tell_first(owner: Any, method: str, tell: Callable[..., object]) -> None:
    """Report each call of a method, before it is carried out."""
    carry_out = getattr(owner, method)

    def told(*arguments: Any) -> Any:
        tell(*arguments)
        return carry_out(*arguments)

    setattr(owner, method, told)
