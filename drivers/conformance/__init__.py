"""The contract that any amplifier must keep, whatever its wire, as checks that say what they prove.

Run against hardware by `era amp conformance URL`, and by the project's tests over every backend.
The first checks only read. The others arm the amplifier and let its channels vibrate; each begins
and ends disarmed.
"""

from drivers.conformance import ending, looking, playing, shaping
from drivers.conformance.bench import LEVEL
from drivers.conformance.check import Check, CheckResult, Steps, run_check

__all__ = ["CHECKS", "LEVEL", "Check", "CheckResult", "run_check"]

_LOOKING: tuple[Steps, ...] = (
    looking.identity,
    looking.capabilities,
    looking.starts_disarmed,
    looking.looking_on,
)
_DRIVING: tuple[Steps, ...] = (
    playing.plays_nothing_disarmed,
    playing.achieved,
    playing.unnamed_channels,
    playing.all_or_nothing,
    playing.stage_and_commit,
    playing.tokens,
    playing.ramps,
    playing.patience,
    ending.quick_stop,
    ending.disarm,
    ending.watchdog,
    ending.heartbeats,
    ending.valid_for,
    shaping.envelopes,
    shaping.missing_envelopes,
)


def _checks(*several: Steps, drives: bool) -> tuple[Check, ...]:
    return tuple(
        Check(
            name=steps.__name__,
            proves=(steps.__doc__ or "").removeprefix("It ").removesuffix("."),
            drives=drives,
            run=steps,
        )
        for steps in several
    )


CHECKS = (*_checks(*_LOOKING, drives=False), *_checks(*_DRIVING, drives=True))
"""In the order in which they are run."""
