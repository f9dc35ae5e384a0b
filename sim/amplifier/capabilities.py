"""Capabilities of a simulated amplifier."""

from drivers.protocol.records import Values
from drivers.protocol.table import FEATURES, QUANTITIES

LAYERS, VOICES = 8, 16
LOWEST = 10.0  # Hz; the guard's floor: below it a plate only rocks


def capabilities(channels: int, *, is_output: bool = False) -> Values:
    """Capabilities of a simulated amplifier with this number of channels.

    is_output: full level is a linear amplifier's output, else the stroke of a motion.
    """
    features = ("events", "interlock", "electrical", "address", *(("output",) if is_output else ()))
    full = {name: quantity.maximum for name, quantity in QUANTITIES.items()}
    low, high = QUANTITIES["frequency"].to_wire(LOWEST), full["frequency"]
    limits = {"frequency_min": low, "frequency_max": high, "level_max": full["level"]}
    return {
        **{"channels": channels, "layers": LAYERS, "voices": VOICES, "set_words": 4096},
        **{"knots": full["knots"], "features": sum(1 << FEATURES[each] for each in features)},
        **limits,
        **{"frequency_step": 1, "level_step": 1, "phase_step": 1, "slew": full["slew"]},
        **{"ramp_max": full["ramp"], "watchdog_min": QUANTITIES["watchdog"].minimum},
        **{"watchdog_max": full["watchdog"]},
        **{"envelope_step_min": 10, "envelope_step_max": full["envelope_step"]},
        "limits": [dict(limits) for _ in range(channels)],
    }
