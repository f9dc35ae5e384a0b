"""A witness of amplifiers by their URLs, and of a control loop in virtual time."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from typing import Any, get_args

from controller.play.loop import Controller
from era_haptics.lab.witness.capture import (
    AmplifierConfig,
    ChannelLimits,
    TimeLimits,
    WitnessConfig,
)
from era_haptics.lab.witness.witness_cli import parse_endpoint
from plate_witness import OperatorCommand, PlateTimes, PlateWitness
from registry import threads
from sim.amplifier.simulated_amplifier import Amplifier
from sim.faults import FaultWindow
from virtual_loop import VirtualLoop


def witness_config(
    urls: Mapping[str, str],
    *,
    channels: int = 4,
    times: TimeLimits = TimeLimits(),  # noqa: B008  frozen
    **limits: Any,
) -> WitnessConfig:
    """A configuration with wires named by their location; limits: of all channels."""
    endpoints = {name: parse_endpoint(url) for name, url in urls.items()}
    of_all = ChannelLimits(**{"frequency": (40, 500), "level": 1.0, **limits})
    return WitnessConfig(
        {endpoint.location: endpoint.kind for endpoint in endpoints.values()},
        {
            name: AmplifierConfig(one.location, one.address, dict.fromkeys(range(channels), of_all))
            for name, one in endpoints.items()
        },
        times,
    )


def sense(witness: PlateWitness, now: float, name: str, amplifier: Amplifier) -> None:
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


class LoopWitness(PlateWitness):
    """A witness of all wires of a control loop, in virtual time, by the URLs of its amplifiers.

    It hears only what a host hears that has the wires open. limits: see `PlateWitness`; judged: by
    what it judges, as for `witness_config`.
    """

    def __init__(
        self,
        urls: Mapping[str, str],
        limits: PlateTimes = PlateTimes(),  # noqa: B008  frozen
        **judged: Any,
    ) -> None:
        super().__init__(witness_config(urls, **judged), limits)
        self._is_open = False
        self._active_faults = 0
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        self.loop = loop
        loop.seen = self.seen

    def seen(self, link: str, toward: str, data: bytes) -> None:
        """Hear bytes, unless no host has the link open."""
        if self._is_open:
            self.record_bytes(link, toward, threads.now(), data)  # type: ignore[arg-type]

    def follow(self, controller: Controller) -> None:
        """Hear of each command, opening and closing of a control loop."""
        for command in get_args(OperatorCommand):
            tell_first(controller, command, partial(self.commanded, command))
        tell_first(controller, "open", self.opens)
        controller.release = partial(self._released, controller.release)  # type: ignore[method-assign]

    def commanded(self, command: OperatorCommand) -> None:
        """An operator's command is about to be carried out."""
        self.operator_command(threads.now(), command)

    def opens(self) -> None:
        """A host is about to open all wires."""
        self._is_open = True
        for link in self.wires:
            self.opened(link, threads.now())

    def closes(self) -> None:
        """The host has closed all, or died."""
        self._is_open = False
        for link in self.wires:
            self.closed(link, threads.now())

    async def _released(self, release: Callable[[], Awaitable[None]]) -> None:
        try:
            await release()
        finally:
            self.closes()

    def inject_fault(self, window: FaultWindow) -> None:
        """A fault begins. What it does to one wire, a controller of all may show on each."""
        self.disturb()
        lasts = window.lasts + (window.delay if window.fault == "delay" else 0.0)
        if lasts < math.inf:
            self.loop.call_later(lasts, self.disturb, -1)

    def disturb(self, change: int = 1) -> None:
        """One more fault is active on all wires, or by -1 one less."""
        self._active_faults += change
        for link in self.wires:
            self.faults(threads.now(), link, are_on=self._active_faults > 0)


def tell_first(owner: Any, method: str, tell: Callable[..., object]) -> None:
    """Report each call of a method, before it is carried out."""
    carry_out = getattr(owner, method)

    def told(*arguments: Any) -> Any:
        tell(*arguments)
        return carry_out(*arguments)

    setattr(owner, method, told)
