"""The guard: nothing is played that it has not let through."""

from drivers.guard.guard import Guard, SafeCommandSet, SafeEnvelope
from drivers.guard.limits import FREQUENCY_CEILING, FREQUENCY_FLOOR, LEVEL_CEILING, GuardLimits
from drivers.guard.required import require_safe

__all__ = [
    "FREQUENCY_CEILING",
    "FREQUENCY_FLOOR",
    "LEVEL_CEILING",
    "Guard",
    "GuardLimits",
    "SafeCommandSet",
    "SafeEnvelope",
    "require_safe",
]
