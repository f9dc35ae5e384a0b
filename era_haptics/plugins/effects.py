"""For what a finger feels over time: entry points `era_haptics.effects`."""

from controller.effects.effect import Course, Effect, Feeling, Level, Nothing
from controller.effects.kinds import effect_kind
from controller.sources.contacts import Contact, ContactKey
from model.config.sections import Quantity
from model.config.units import FREQUENCY, LENGTH, RATIO, SPEED, TIME

__all__ = [
    "FREQUENCY",
    "LENGTH",
    "RATIO",
    "SPEED",
    "TIME",
    "Contact",
    "ContactKey",
    "Course",
    "Effect",
    "Feeling",
    "Level",
    "Nothing",
    "Quantity",
    "effect_kind",
]
