"""What the opened amplifiers of a rig can play together, in the table's words."""

from collections.abc import Mapping
from dataclasses import dataclass

from controller.group.guards import guard_limits
from controller.loop.envelopes import ENVELOPE_TIME, Loading, Shaping, shaping_of
from drivers.guard import limits_in_force
from model.drive_modes import DRIVE_MODES, playable_drive_modes
from model.errors import InputError
from model.rig.rig import Rig


@dataclass(frozen=True)
class PlaybackCapabilities:
    """What patterns may be made of.

    drive_mode: in which the table is asked; playable: the modes that every amplifier can play;
    frequencies: the lowest and highest [Hz]; largest: amplitude [m] by ERA; shaping: which
    envelopes all of them play.
    """

    drive_mode: str
    playable: tuple[str, ...]
    frequencies: tuple[float, float]
    largest: Mapping[str, float]
    shaping: Shaping


def playback_capabilities(
    rig: Rig,
    amplifiers: Mapping[str, Loading],
    *,
    drive_mode: str | None = None,
    envelope_time: float = ENVELOPE_TIME,
) -> PlaybackCapabilities:
    """What the open amplifiers of a rig, by name, can play.

    drive_mode: None for the best that all can play; envelope_time [s]: how long loading envelopes
    may delay a touch, 0 for ramps only. Raises InputError for a mode that one cannot play.
    """
    capabilities = {name: amplifier.capabilities for name, amplifier in amplifiers.items()}
    each = [
        playable_drive_modes(level_step=caps.level_step, phase_step=caps.phase_step)
        for caps in capabilities.values()
    ]
    playable = tuple(name for name in DRIVE_MODES if all(name in modes for modes in each))
    if drive_mode is not None and drive_mode not in playable:
        raise InputError(
            f"drive mode {drive_mode} is not playable, only {', '.join(playable)}; "
            "choose one of these, or none for the best"
        )
    configured = guard_limits(rig.limits)
    limits = {name: limits_in_force(configured, caps) for name, caps in capabilities.items()}
    return PlaybackCapabilities(
        drive_mode=drive_mode or playable[-1],
        playable=playable,
        frequencies=(
            max(one.frequency_min for one in limits.values()),
            min(one.frequency_max for one in limits.values()),
        ),
        largest={
            era.name: era.stroke * limits[rig.wiring[era.name].amplifier].level for era in rig.eras
        },
        shaping=shaping_of(rig, amplifiers, within=envelope_time),
    )
