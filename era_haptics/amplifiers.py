"""Amplifiers of a rig for scripts: opened by the rig's URLs and limits."""

from controller.play.routing import route
from drivers.by_hand.actions import BlockingAmplifier
from drivers.playing.contents import Layer as AmplifierLayer
from era_haptics.arguments import expect_rig
from era_haptics.drive import Played, layers_of
from model.errors import InputError, shown
from model.rig.rig import Rig


def open_amplifier(
    rig: Rig, name: str | None = None, *, url: str | None = None
) -> BlockingAmplifier:
    """Make an amplifier of the rig, open within a `with` block and disarmed after it.

    name: optional if the rig has only one; url: instead of the rig's. Commands beyond the rig's
    limits are refused. Raises InputError for an unknown name; in the block CommandError for an
    invalid URL, LinkError without a reply, CommandRefused.

    Example:
        >>> url = "sim://examples/paper_plate.yaml"
        >>> with era.open_amplifier(rig, url=url) as amplifier:
        ...     print(amplifier.capabilities["channels"], "channels")
        4 channels
    """
    expect_rig(rig)
    known = tuple(rig.amplifiers)
    chosen = known if name is None else tuple(each for each in known if each == name)
    if len(chosen) != 1:
        raise InputError(f"name must be an amplifier of the rig, {', '.join(known)}, got {name!r}")
    if url is not None and not isinstance(url, str):
        raise InputError(f"url must be text such as 'sim://', got {shown(url)}")
    (found,) = chosen
    return BlockingAmplifier(url or rig.amplifiers[found], limits=rig.limits)


def commands_for(rig: Rig, drive: Played) -> dict[str, tuple[AmplifierLayer, ...]]:
    """Convert to layers by name of the amplifier, for its `play` and `apply`.

    One for each layer of an answer, and for each of its side bands, with its ramp, onset and
    ending; channels by the rig's wiring. Raises InputError for a drive that the rig cannot play.

    Example:
        >>> layers = era.commands_for(rig, only)["main"]
        >>> [(tone.channel, round(tone.level, 3)) for tone in layers[0].tones]
        [(0, 0.027), (1, 0.038), (2, 0.005), (3, 0.008)]
    """
    expect_rig(rig)
    voices = [voice for layer in layers_of(drive, rig) for voice in layer.voices]
    routed = [
        route(
            each.excitation,
            rig,
            ramp=each.ramp,
            number=number,
            onset=each.onset,
            ending=each.ending,
        )
        for number, each in enumerate(voices)
    ]
    return {name: tuple([each[name] for each in routed]) for name in rig.amplifiers}
