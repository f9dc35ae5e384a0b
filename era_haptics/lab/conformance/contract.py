"""The checks of an amplifier's conformance to protocol 4, in order of execution.

Checks that only read come first; the others arm the amplifier and drive its channels.
"""

from era_haptics.lab.conformance.check import ConformanceCheck
from era_haptics.lab.conformance.checks import (
    can_checks,
    clock_checks,
    frame_checks,
    identity_checks,
    layer_checks,
    line_checks,
    modbus_checks,
    part_checks,
    request_checks,
    serial_checks,
    set_checks,
    start_checks,
    state_checks,
    sum_checks,
    transition_checks,
    watchdog_checks,
)

_READING = (
    identity_checks.identity,
    identity_checks.capabilities,
    identity_checks.starts_disarmed,
    clock_checks.clock_goes_on,
    request_checks.replies_in_time,
    request_checks.unknown_types,
    identity_checks.reading_changes_nothing,
    serial_checks.hello_for_ever,
    serial_checks.half_words,
    modbus_checks.areas,
    modbus_checks.pieces,
    can_checks.objects,
    request_checks.lengths,
)
_STATES = (
    state_checks.stop,
    state_checks.stop_ramps,
    state_checks.silence_never_later,
    state_checks.stop_ends_all,
    state_checks.stops_are_numbered,
    state_checks.clear_too_early,
    state_checks.silence,
    state_checks.plays_nothing_disarmed,
    state_checks.arming,
    watchdog_checks.watchdog_ranges,
    state_checks.arms_again,
    state_checks.sessions,
    state_checks.arming_ends_fades,
    request_checks.obeys_in_time,
)
_WATCHDOG = (
    watchdog_checks.watchdog,
    watchdog_checks.watchdog_unread,
    watchdog_checks.what_feeds,
    watchdog_checks.what_does_not_feed,
    watchdog_checks.trips_amid_other_requests,
    watchdog_checks.trips_amid_fades,
    watchdog_checks.fault_list,
)
_SETS = (
    set_checks.every_channel,
    set_checks.levels_of_every_frequency,
    set_checks.achieved,
    set_checks.steps_as_stated,
    set_checks.all_or_nothing,
    set_checks.accepts_its_ranges,
    part_checks.parts_of_sets,
    part_checks.parts_that_are_dropped,
    part_checks.parts_again,
    part_checks.refused_parts,
    part_checks.empty_sets,
    part_checks.max_set,
    part_checks.sets_expire,
)
_STARTS = (
    start_checks.stage_and_commit,
    start_checks.repeats_change_nothing,
    start_checks.tokens_wrap,
    start_checks.newer_sets_replace,
    start_checks.committed_together,
    start_checks.starts_at_its_moment,
    start_checks.what_waits_for_its_moment,
    clock_checks.clock_readings,
    clock_checks.clock_shifts,
    clock_checks.clock_rate,
)
_LAYERS = (
    layer_checks.layers_add,
    layer_checks.layers_play_on,
    layer_checks.valid_for,
    layer_checks.renew,
    layer_checks.after,
    layer_checks.after_the_last_onset,
    layer_checks.what_waits_for_an_onset,
)
_TRANSITIONS = (
    transition_checks.ramps,
    transition_checks.cross_fades,
    transition_checks.kept_phase,
    transition_checks.onsets,
    transition_checks.endings,
    transition_checks.endings_amid,
    transition_checks.extreme_envelopes,
    sum_checks.phases,
    sum_checks.voices,
    sum_checks.limited,
)
_FRAMES = (
    frame_checks.damaged_frames,
    frame_checks.doubled_frames,
    serial_checks.tolerated_frames,
    serial_checks.discarded_frames,
    modbus_checks.present_areas,
    modbus_checks.exceptions,
    can_checks.numbers,
    can_checks.network_management,
    can_checks.heartbeats,
    can_checks.emergencies,
)
_LINES = (
    line_checks.events,
    line_checks.broadcasts,
    clock_checks.mark,
    line_checks.addresses,
    identity_checks.measured,
)
CHECKS: tuple[ConformanceCheck, ...] = (
    *_READING,
    *_STATES,
    *_WATCHDOG,
    *_SETS,
    *_STARTS,
    *_LAYERS,
    *_TRANSITIONS,
    *_FRAMES,
    *_LINES,
)
"""All checks; their numbers begin at 1."""


def of_kind(kind: str) -> list[tuple[int, ConformanceCheck]]:
    """Return the checks for a kind of wire with their numbers."""
    numbered = enumerate(CHECKS, 1)
    return [(number, check) for number, check in numbered if not check.kinds or kind in check.kinds]
