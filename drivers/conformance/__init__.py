"""The contract of every amplifier, whatever its wire, as checks.

Run against hardware by `era amp conformance URL`, and by the project's tests over every backend.
The first checks only read. The others arm the amplifier and drive its channels; each begins and
ends disarmed.
"""

from drivers.conformance import (
    ending,
    envelopes,
    fades,
    frames,
    playing,
    reading,
    sessions,
    tokens,
    vanishing,
    watchdog,
)
from drivers.conformance.bench import LEVEL
from drivers.conformance.check import Check, CheckResult, Result, run_check
from drivers.conformance.raw.opening import raw_line

__all__ = ["CHECKS", "LEVEL", "Check", "CheckResult", "Result", "raw_line", "run_check"]

CHECKS: tuple[Check, ...] = (
    reading.identity,
    reading.capabilities,
    reading.starts_disarmed,
    reading.reading_changes_nothing,
    reading.replies_in_time,
    playing.plays_nothing_disarmed,
    playing.arming_forgets,
    playing.achieved,
    playing.steps_as_stated,
    playing.stated_ranges,
    playing.every_channel,
    playing.achieved_of_every_channel,
    playing.unnamed_channels,
    playing.all_or_nothing,
    tokens.stage_and_commit,
    tokens.second_stage,
    tokens.tokens,
    tokens.tokens_wrap,
    tokens.staged_sets_expire,
    tokens.cancelled_requests,
    fades.ramp_up,
    fades.ramp_down,
    fades.ramps_of_other_lengths,
    fades.interrupted_ramps,
    fades.earlier_ends_stay,
    fades.voices,
    fades.phases,
    fades.ramps_of_valid_for,
    ending.valid_for,
    ending.valid_for_is_of_its_set,
    ending.quick_stop,
    ending.stop_ramp,
    ending.stop_ramp_clipped,
    ending.clear_too_early,
    ending.silence_never_later,
    ending.stop_ends_fades,
    ending.disarm,
    ending.arming_ends_fades,
    watchdog.watchdog,
    watchdog.watchdog_times,
    watchdog.watchdog_without_reading,
    watchdog.watchdog_left,
    watchdog.what_feeds,
    watchdog.what_does_not_feed,
    watchdog.trips_amid_other_requests,
    watchdog.arms_again,
    sessions.sessions,
    sessions.clear_names_the_stop,
    sessions.fault_list,
    sessions.events,
    frames.invalid_frames,
    frames.invalid_frames_do_not_feed,
    frames.tolerated_frames,
    frames.frames_in_any_order,
    frames.broadcasts,
    envelopes.onsets,
    envelopes.endings,
    envelopes.skipped_endings,
    envelopes.interrupted_endings,
    envelopes.loaded_while_playing,
    envelopes.kept_phase_onset,
    envelopes.watchdog_skips_endings,
    envelopes.missing_envelopes,
    vanishing.vanished_host,
)
"""All checks, in their order of execution."""
