"""Conformance contract of every protocol 4 amplifier, as a list of checks for all wires.

Runs against hardware by URL, and in the project's tests over every wire in virtual time. Read-only
checks come first; the others arm the amplifier and drive its channels.
"""

import random
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from functools import partial

from drivers.errors import LinkError
from drivers.protocol.definition import MAX_WORDS
from drivers.wires.wire import address_of
from era_haptics.lab.conformance.check import (
    CheckResult,
    ConformanceCheck,
    ConformanceReport,
    Result,
    run_checks,
)
from era_haptics.lab.conformance.checks import (
    frame_checks,
    playing_checks,
    reading_checks,
    set_checks,
    state_checks,
)
from era_haptics.lab.conformance.judge_client import ContractViolation, JudgeClient, TooLate
from era_haptics.lab.conformance.subject import DEFAULT_LEVEL
from registry import threads

__all__ = [
    "CHECKS",
    "CLIENTS",
    "DEFAULT_LEVEL",
    "CheckResult",
    "ConformanceCheck",
    "ConformanceReport",
    "Result",
    "judge",
    "of_kind",
    "opened",
]

CHECKS: tuple[ConformanceCheck, ...] = (
    reading_checks.identity,
    reading_checks.capabilities,
    reading_checks.starts_disarmed,
    playing_checks.clock_goes_on,
    reading_checks.replies_in_time,
    reading_checks.unknown_types,
    reading_checks.reading_changes_nothing,
    reading_checks.hello_for_ever,
    reading_checks.half_words,
    frame_checks.areas,
    frame_checks.pieces,
    reading_checks.objects,
    reading_checks.lengths,
    state_checks.stop,
    state_checks.stop_ramps,
    state_checks.silence_never_later,
    state_checks.stop_ends_all,
    state_checks.stops_are_numbered,
    state_checks.clear_too_early,
    state_checks.silence,
    state_checks.plays_nothing_disarmed,
    state_checks.arming,
    state_checks.watchdog_ranges,
    state_checks.arms_again,
    state_checks.sessions,
    state_checks.arming_ends_fades,
    reading_checks.obeys_in_time,
    state_checks.watchdog,
    state_checks.watchdog_unread,
    state_checks.what_feeds,
    state_checks.what_does_not_feed,
    state_checks.trips_amid_other_requests,
    state_checks.trips_amid_fades,
    state_checks.fault_list,
    set_checks.every_channel,
    set_checks.levels_of_every_frequency,
    set_checks.achieved,
    set_checks.steps_as_stated,
    set_checks.all_or_nothing,
    set_checks.accepts_its_ranges,
    set_checks.parts_of_sets,
    set_checks.parts_that_are_dropped,
    set_checks.parts_again,
    set_checks.refused_parts,
    set_checks.empty_sets,
    set_checks.max_set,
    set_checks.sets_expire,
    set_checks.stage_and_commit,
    set_checks.repeats_change_nothing,
    set_checks.tokens_wrap,
    set_checks.newer_sets_replace,
    set_checks.committed_together,
    set_checks.starts_at_its_moment,
    set_checks.what_waits_for_its_moment,
    playing_checks.clock_readings,
    playing_checks.clock_shifts,
    playing_checks.clock_rate,
    playing_checks.layers_add,
    playing_checks.layers_play_on,
    playing_checks.valid_for,
    playing_checks.renew,
    playing_checks.after,
    playing_checks.after_the_last_onset,
    playing_checks.what_waits_for_an_onset,
    playing_checks.ramps,
    playing_checks.cross_fades,
    playing_checks.kept_phase,
    playing_checks.onsets,
    playing_checks.endings,
    playing_checks.endings_amid,
    playing_checks.extreme_envelopes,
    playing_checks.phases,
    playing_checks.voices,
    playing_checks.limited,
    frame_checks.damaged_frames,
    frame_checks.doubled_frames,
    frame_checks.tolerated_frames,
    frame_checks.discarded_frames,
    frame_checks.present_areas,
    frame_checks.exceptions,
    frame_checks.numbers,
    reading_checks.network_management,
    reading_checks.heartbeats,
    reading_checks.emergencies,
    reading_checks.events,
    reading_checks.broadcasts,
    reading_checks.mark,
    reading_checks.addresses,
    playing_checks.measured,
)
"""All checks in order of execution."""


def of_kind(kind: str) -> list[tuple[int, ConformanceCheck]]:
    """Return the checks for a kind of wire with their numbers."""
    numbered = enumerate(CHECKS, 1)
    return [(number, check) for number, check in numbered if not check.kinds or kind in check.kinds]


CLIENTS: Mapping[str, Callable[[int], JudgeClient]] = {
    "serial": frame_checks.SerialClient,
    "CAN": frame_checks.CanClient,
    "Modbus RTU": partial(frame_checks.ModbusClient, is_rtu=True),
    "Modbus TCP": partial(frame_checks.ModbusClient, is_rtu=False),
}
"""Client classes by the protocol of a wire."""


@asynccontextmanager
async def opened(url: str) -> AsyncIterator[JudgeClient]:
    """Open the amplifier at a URL within a context, and wait until its board has started.

    Raises CommandError for an invalid URL, LinkError for a line that cannot be opened.
    """
    address = address_of(url)
    protocol = str(address.settings["protocol"])
    if protocol not in CLIENTS:
        raise LinkError(f"{url}: wire must be {', '.join(CLIENTS)}, got {protocol}")
    client = CLIENTS[protocol](address.number)
    client.name = url
    port = await address.open_port(client.received, client.lost)
    client.transmit = port.write
    try:
        boots_until = threads.now() + address.boot_time
        while threads.now() < boots_until:  # ignore boot messages of the board
            with suppress(ContractViolation, TooLate):
                await client.hello()
                break
        client.session = random.getrandbits(16)
        client.wire_time = address.make_wire().exchange_time
        client.transit = client.wire_time(0, MAX_WORDS)
        yield client
    finally:
        port.close()
        await port.wait_closed()


async def judge(
    url: str,
    *,
    drives: bool,
    level: float = DEFAULT_LEVEL,
    on_result: Callable[[CheckResult], None] = lambda result: None,
    before: ConformanceReport | None = None,
) -> ConformanceReport:
    """Check the amplifier at a URL, and leave it silent and disarmed.

    drives: include checks that arm it and drive its channels, at up to `level` of full level.
    on_result: called with each result. before: report of checks that are not repeated. Raises
    CommandError for an invalid URL, LinkError for a line that cannot be opened or is lost.
    """
    results = () if before is None else before.results
    known = {each.number for each in results}
    async with opened(url) as client:
        checks = of_kind(client.kind)
        chosen = [
            (number, check)
            for number, check in checks
            if number not in known and (drives or not check.drives)
        ]
        found = await run_checks(chosen, client, level=level, on_result=on_result, before=results)
    results = (*results, *found)
    return ConformanceReport(url, level, results, len(checks) - len(results))
