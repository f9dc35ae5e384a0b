"""What an amplifier does at a time, for those who look on."""

from dataclasses import dataclass


@dataclass(frozen=True)
class AmplifierSummary:
    """Names of its state and fault, the token committed last, and the level of each channel."""

    state: str
    fault: str
    token: int
    is_high_voltage: bool
    levels: tuple[float, ...]
