"""The guard: only what it has checked can be encoded and played."""

from drivers.guard.guard import (
    Guard,
    SafeCommandSet,
    SafeEnvelope,
    safe_voltage_envelope,
    safe_voltages,
)
from drivers.guard.limits import (
    FREQUENCY_CEILING,
    FREQUENCY_FLOOR,
    LEVEL_CEILING,
    limits_in_force,
)
from drivers.guard.required import require_safe, require_safe_set
from registry.limits import GuardLimits

__all__ = [
    "FREQUENCY_CEILING",
    "FREQUENCY_FLOOR",
    "LEVEL_CEILING",
    "Guard",
    "GuardLimits",
    "SafeCommandSet",
    "SafeEnvelope",
    "limits_in_force",
    "require_safe",
    "require_safe_set",
    "safe_voltage_envelope",
    "safe_voltages",
]
