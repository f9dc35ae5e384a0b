"""Cases of the plant benchmark as values, so that numpy is loaded later."""

from dataclasses import dataclass

STEP = 0.01  # s
FINGERS = ((0.10, 0.08), (0.25, 0.17), (0.05, 0.19), (0.18, 0.03), (0.28, 0.05),
           (0.15, 0.14), (0.21, 0.20), (0.03, 0.03), (0.12, 0.21), (0.20, 0.10))  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A simulated case: numbers of ERAs, amplifiers and fingers."""

    eras: int = 4
    amplifiers: int = 1
    fingers: int = 2
    loading: bool = False
    frequency_max: float = 500.0
    step: float = STEP
    taps: int = 0  # per second
    commands: int = 0  # per second
