"""Configure a witness by the URLs of amplifiers, and show it what they play."""

from collections.abc import Callable, Mapping
from typing import Any

from sim.amplifier.contract import Amplifier
from sim.witness.witness import Witness
from sim.witness_relay import parse_endpoint


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


def tell_first(owner: Any, method: str, tell: Callable[..., object]) -> None:
    """Report each call of a method, before it is carried out."""
    carry_out = getattr(owner, method)

    def told(*arguments: Any) -> Any:
        tell(*arguments)
        return carry_out(*arguments)

    setattr(owner, method, told)
