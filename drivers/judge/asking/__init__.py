"""The contract of every amplifier of protocol 4, on whatever wire, as checks.

Run against hardware by its URL, and by the project's tests over every wire in virtual time. Checks
that only read come first; the others arm the amplifier and drive its channels.
"""

import random
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from functools import partial

from drivers.errors import LinkError
from drivers.judge.asking import (
    can_frames,
    can_node,
    clocks,
    modbus_frames,
    playing,
    reading,
    sensors,
    serial_frames,
    set_parts,
    sets,
    staging,
    states,
)
from drivers.protocol.definition import MAX_WORDS
from drivers.wires.known import address_of
from era_haptics.lab.conformance.check import Check, CheckResult, Report, Result, run_checks
from era_haptics.lab.conformance.judge_client import Client, Late, Violation
from era_haptics.lab.conformance.subject import LEVEL
from registry import threads

__all__ = [
    "CHECKS",
    "CLIENTS",
    "LEVEL",
    "Check",
    "CheckResult",
    "Report",
    "Result",
    "judge",
    "of_kind",
    "opened",
]

CHECKS: tuple[Check, ...] = (
    *(reading.identity, reading.capabilities, reading.starts_disarmed, clocks.clock_goes_on),
    *(reading.replies_in_time, reading.unknown_types, reading.reading_changes_nothing),
    reading.hello_for_ever,
    *(sensors.sensors, modbus_frames.areas, modbus_frames.pieces, can_node.objects),
    *(reading.lengths, states.stop, states.stop_ramps, states.silence_never_later),
    *(states.stop_ends_all, states.stops_are_numbered, states.clear_too_early),
    *(states.silence, states.plays_nothing_disarmed, states.arming, states.watchdog_ranges),
    *(states.arms_again, states.sessions, states.arming_ends_fades, reading.obeys_in_time),
    *(states.watchdog, states.watchdog_unread, states.what_feeds),
    *(states.what_does_not_feed, states.trips_amid_other_requests),
    *(states.trips_amid_fades, states.fault_list),
    *(sets.every_channel, sets.levels_of_every_frequency, sets.achieved, sets.steps_as_stated),
    *(sets.all_or_nothing, sets.accepts_its_ranges, set_parts.parts_of_sets),
    *(set_parts.parts_that_are_dropped, set_parts.parts_again, set_parts.refused_parts),
    *(set_parts.empty_sets, set_parts.max_set, set_parts.sets_expire),
    *(staging.stage_and_commit, staging.repeats_change_nothing, staging.tokens_wrap),
    *(staging.newer_sets_replace, staging.committed_together, staging.starts_at_its_moment),
    staging.what_waits_for_its_moment,
    *(clocks.clock_readings, clocks.clock_shifts, clocks.clock_rate),
    *(playing.layers_add, playing.layers_play_on, playing.valid_for, playing.renew, playing.after),
    *(playing.after_the_last_onset, playing.what_waits_for_an_onset),
    *(playing.ramps, playing.cross_fades, playing.kept_phase, playing.onsets, playing.endings),
    *(playing.endings_amid, playing.extreme_envelopes, playing.phases, playing.voices),
    playing.limited,
    *(serial_frames.damaged_frames, serial_frames.doubled_frames, serial_frames.tolerated_frames),
    serial_frames.discarded_frames,
    *(modbus_frames.present_areas, modbus_frames.exceptions),
    *(can_frames.numbers, can_node.network_management, can_node.heartbeats),
    can_node.emergencies,
    *(reading.events, reading.broadcasts, reading.mark, reading.addresses),
    *(sensors.measured, sensors.readings),
)
"""All checks, in their order of execution."""


def of_kind(kind: str) -> list[tuple[int, Check]]:
    """Return the checks of a kind of wire, each with its number."""
    numbered = enumerate(CHECKS, 1)
    return [(number, check) for number, check in numbered if not check.kinds or kind in check.kinds]


CLIENTS: Mapping[str, Callable[[int], Client]] = {
    "serial": serial_frames.SerialClient,
    "CAN": can_frames.CanClient,
    "Modbus RTU": partial(modbus_frames.ModbusClient, is_rtu=True),
    "Modbus TCP": partial(modbus_frames.ModbusClient, is_rtu=False),
}
"""Clients by the protocol that a wire's settings name."""


@asynccontextmanager
async def opened(url: str) -> AsyncIterator[Client]:
    """The client of an amplifier by its URL while its line is open, and its board has started.

    Raises CommandError for text that is no URL, LinkError for a line that cannot be opened.
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
        while threads.now() < boots_until:  # what a board says while it starts is no reply
            with suppress(Violation, Late):
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
    level: float = LEVEL,
    on_result: Callable[[CheckResult], None] = lambda result: None,
    before: Report | None = None,
) -> Report:
    """Check the amplifier at a URL, and leave it silent and disarmed.

    drives: also what arms it and drives its channels, at this level of full level at most.
    on_result: called with each result. before: report of checks that are not run again. Raises
    CommandError for text that is no URL, LinkError for a line that cannot be opened or is lost.
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
    return Report(url, level, results, len(checks) - len(results))
