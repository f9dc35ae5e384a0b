"""Capabilities of the open amplifiers of a rig together, in the terms of the table."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from controller.loop.envelopes import (
    MAX_LOADING_TIME,
    EnvelopeSupport,
    OpenAmplifier,
    envelope_support,
)
from drivers.guard import limits_in_force
from drivers.protocol.messages import Capabilities, Feature
from model.drive_modes import DRIVE_MODES, playable_drive_modes
from model.errors import InputError
from model.rig.rig import Rig


@dataclass(frozen=True)
class PlaybackCapabilities:
    """Capabilities that all amplifiers of a rig share.

    drive_mode: of the questions to the table; playable: the drive modes that every amplifier can
    play; frequencies: the lowest and highest [Hz]; max_amplitudes [m] by ERA;
    envelope_support: which envelopes every amplifier plays; max_power: sum of squared levels of
    all ERAs; slew [1/s]: highest rise of a level. eras_at_most: how many ERAs may play together;
    ends_itself: whether every amplifier ends a vibration after its time; has_cross_fades: whether
    each changes from one tone to another without silence between.
    """

    drive_mode: str
    playable: tuple[str, ...]
    frequencies: tuple[float, float]
    max_amplitudes: Mapping[str, float]
    envelope_support: EnvelopeSupport
    max_power: float = math.inf
    slew: float = math.inf
    eras_at_most: int = 2
    ends_itself: bool = True
    has_cross_fades: bool = True


def playback_capabilities(
    rig: Rig,
    amplifiers: Mapping[str, OpenAmplifier],
    *,
    drive_mode: str | None = None,
    max_loading_time: float = MAX_LOADING_TIME,
) -> PlaybackCapabilities:
    """Return what the open amplifiers of a rig, by name, can play.

    drive_mode: None for the best that all can; max_loading_time [s]: how long loading envelopes may
    delay a touch, 0 for ramps only. Raises InputError for a drive mode that one cannot play.
    """
    capabilities = {name: amplifier.capabilities for name, amplifier in amplifiers.items()}
    each = [
        playable_drive_modes(level_step=caps.level_step, phase_step=caps.phase_step)
        for caps in capabilities.values()
    ]
    playable = tuple(name for name in DRIVE_MODES if all(name in modes for modes in each))
    is_coherent = _are_coherent(tuple(capabilities.values()))
    if not is_coherent:
        playable = ("switched",)
    if drive_mode is not None and drive_mode not in playable:
        raise InputError(
            f"drive mode must be one that all amplifiers play ({', '.join(playable)}), got "
            f"{drive_mode}; leave it out for the best"
        )
    configured = rig.limits
    limits = {name: limits_in_force(configured, caps) for name, caps in capabilities.items()}
    return PlaybackCapabilities(
        drive_mode=drive_mode or playable[-1],
        playable=playable,
        frequencies=(
            max(one.frequency_min for one in limits.values()),
            min(one.frequency_max for one in limits.values()),
        ),
        max_amplitudes={
            era.name: era.stroke * limits[rig.wiring[era.name].amplifier].level for era in rig.eras
        },
        envelope_support=envelope_support(rig, amplifiers, max_loading_time=max_loading_time),
        max_power=min(one.power for one in limits.values()),
        slew=min(one.slew for one in limits.values()),
        eras_at_most=2 if is_coherent else 1,
        ends_itself=all(Feature.VALID_FOR in caps.features for caps in capabilities.values()),
        has_cross_fades=all(caps.has_cross_fades for caps in capabilities.values()),
    )


def _are_coherent(each: Sequence[Capabilities]) -> bool:
    """Whether phases hold between all channels: within each amplifier, and from a common start."""
    needed = Feature.PHASE if len(each) == 1 else Feature.PHASE | Feature.STAGING
    return all(needed in caps.features for caps in each)
