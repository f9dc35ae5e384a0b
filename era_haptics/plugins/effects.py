"""Interfaces for effects: entry points `era_haptics.effects`."""

from controller.effects.effect import Effect, EffectRun, EffectStimulus, Level, NoStimulus, Region
from controller.effects.kinds import effect_kind
from controller.play.intent import Pulse
from controller.sources.touch import Contact, ContactKey
from model.config.fields import Quantity
from model.config.units import ANGLE, FREQUENCY, LENGTH, RATIO, SPEED, TIME

__all__ = [
    "ANGLE",
    "FREQUENCY",
    "LENGTH",
    "RATIO",
    "SPEED",
    "TIME",
    "Contact",
    "ContactKey",
    "Effect",
    "EffectRun",
    "EffectStimulus",
    "Level",
    "NoStimulus",
    "Pulse",
    "Quantity",
    "Region",
    "effect_kind",
]
