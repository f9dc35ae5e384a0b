"""The contract of every amplifier, whatever its wire, as checks.

Run against hardware by `era amp conformance URL`, and by the project's tests over every backend.
The first checks only read. The others arm the amplifier and drive its channels; each begins and
ends disarmed.
"""

from drivers.conformance import ending, envelopes, playing, reading, sessions
from drivers.conformance.bench import LEVEL
from drivers.conformance.check import Check, CheckResult, Steps, run_check

__all__ = ["CHECKS", "LEVEL", "Check", "CheckResult", "run_check"]

_READING: tuple[Steps, ...] = (
    reading.identity,
    reading.capabilities,
    reading.starts_disarmed,
    reading.reading_changes_nothing,
)
_DRIVING: tuple[Steps, ...] = (
    playing.plays_nothing_disarmed,
    playing.achieved,
    playing.unnamed_channels,
    playing.all_or_nothing,
    playing.stage_and_commit,
    playing.tokens,
    playing.staged_sets_expire,
    playing.ramps,
    playing.cancelled_requests,
    sessions.sessions,
    ending.quick_stop,
    sessions.clear_names_the_stop,
    ending.silence_never_later,
    ending.disarm,
    ending.watchdog,
    ending.heartbeats,
    ending.valid_for,
    envelopes.envelopes,
    envelopes.missing_envelopes,
)


def _checks(*several: Steps, drives: bool) -> tuple[Check, ...]:
    return tuple(
        Check(
            name=steps.__name__,
            requirement=(steps.__doc__ or "").removeprefix("It ").removesuffix("."),
            drives=drives,
            run=steps,
        )
        for steps in several
    )


CHECKS = (*_checks(*_READING, drives=False), *_checks(*_DRIVING, drives=True))
"""All checks, in their order of execution."""
