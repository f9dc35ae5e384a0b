"""Capabilities of the open amplifiers of a rig together, in the terms of the table."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from controller.loop.envelopes import EnvelopeSupport, envelope_support
from drivers.host.amplifier import Amplifier
from drivers.protocol.table import QUANTITIES
from model.drive_modes import DRIVE_MODES, playable_drive_modes
from model.errors import InputError
from model.rig.rig import Rig

_FREQUENCY, _LEVEL, _RAMP = (QUANTITIES[name] for name in ("frequency", "level", "ramp"))
_PHASE_STEP = QUANTITIES["phase_step"]


@dataclass(frozen=True)
class PlaybackCapabilities:
    """Capabilities that all amplifiers of a rig share.

    drive_mode: of the questions to the table; playable: the drive modes that every amplifier can
    play; frequencies: the lowest and highest [Hz]; max_amplitudes [m] by ERA;
    envelope_support: knots that every amplifier plays; max_power: sum of squared levels of
    all ERAs; slew [1/s]: highest rise of a level; ramp_max [s]; layers: contents at once.
    """

    drive_mode: str
    playable: tuple[str, ...]
    frequencies: tuple[float, float]
    max_amplitudes: Mapping[str, float]
    envelope_support: EnvelopeSupport
    max_power: float = math.inf
    slew: float = math.inf
    ramp_max: float = math.inf
    layers: int = 1


def playback_capabilities(
    rig: Rig, amplifiers: Mapping[str, Amplifier], *, drive_mode: str | None = None
) -> PlaybackCapabilities:
    """Return what the open amplifiers of a rig, by name, can play.

    drive_mode: None for the best that all can. Raises InputError for a drive mode that one cannot
    play, or a wired channel that its amplifier does not have.
    """
    for era, wired in rig.wiring.items():
        channels = amplifiers[wired.amplifier].capabilities["channels"]
        if wired.number >= channels:
            raise InputError(
                f"channel of ERA {era} must be 0 to {channels - 1} on amplifier "
                f"{wired.amplifier}, got {wired.number}; change its wiring in the rig file"
            )
    each = [
        playable_drive_modes(
            level_step=_LEVEL.from_wire(one.capabilities["level_step"]),
            phase_step=_PHASE_STEP.from_wire(one.capabilities["phase_step"]),
        )
        for one in amplifiers.values()
    ]
    playable = tuple(name for name in DRIVE_MODES if all(name in modes for modes in each))
    if drive_mode is not None and drive_mode not in playable:
        raise InputError(
            f"drive mode must be one that all amplifiers play ({', '.join(playable)}), got "
            f"{drive_mode}; leave it out for the best"
        )
    limits = {name: one.ledger.limits for name, one in amplifiers.items()}
    return PlaybackCapabilities(
        drive_mode=drive_mode or playable[-1],
        playable=playable,
        frequencies=(
            max(_FREQUENCY.from_wire(one.frequency_min) for one in limits.values()),
            min(_FREQUENCY.from_wire(one.frequency_max) for one in limits.values()),
        ),
        max_amplitudes={
            era.name: era.stroke * _LEVEL.from_wire(limits[rig.wiring[era.name].amplifier].level)
            for era in rig.eras
        },
        envelope_support=envelope_support(rig, amplifiers),
        max_power=min(one.power for one in limits.values()),
        slew=min(one.slew for one in limits.values()),
        ramp_max=min(_RAMP.from_wire(one.capabilities["ramp_max"]) for one in amplifiers.values()),
        layers=min(one.capabilities["layers"] for one in amplifiers.values()),
    )
