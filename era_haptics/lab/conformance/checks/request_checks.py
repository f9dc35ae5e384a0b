"""Checks of requests on every wire: reply times, unknown messages, lengths."""

import math
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from drivers.protocol.definition import MESSAGES, REACTION, RESERVED_MESSAGES
from era_haptics.lab.conformance.check import driving, reading
from era_haptics.lab.conformance.judge_client import in_batches
from era_haptics.lab.conformance.outcomes import expect_equal, expect_within
from era_haptics.lab.conformance.request_rows import RequestRows, send, stage
from era_haptics.lab.conformance.subject import Subject

UNKNOWN_NUMBERS = (*RESERVED_MESSAGES, 20, 24, 29, 63)
"""Unassigned message numbers, below the vendors' range."""
_TRIES = 20  # for a prompt reply
_BATCH = 4  # requests without a status in between
_FEATURES = {"GetMeasured": "electrical", "SetAddress": "address", "Mark": "mark"}
"""Features of messages that an amplifier can lack."""
_VALID_VALUES: dict[str, Any] = {
    "session": 1,
    "watchdog": 250,
    "ramp": 5,
    "token": 1,
    "index": 0,
    "parts": 1,
    "now": 0,
    "stream": [],
    "latch": 0,
    "layer": 0,
    "address": 9,
    "serial_number": "?",
    "shift": 0,
    "rate": 0,
    "at": 0,
}


def valid_words(name: str, **values: Any) -> list[int]:
    """Return the words of a request that is valid except for the state, or has other values."""
    return MESSAGES[name].request.pack({**_VALID_VALUES, **values})


@reading("protocol.md#times")
async def replies_in_time(subject: Subject) -> None:
    """GetStatus, GetCaps and GetFaults: each reply begins within 10 ms.

    Reply from memory, without waiting for a converter, for flash or for the next block of samples.
    A delay of an emulator, serial server or adapter on the way counts too.
    """
    for name in ("GetStatus", "GetCaps", "GetFaults"):
        await _expect_prompt(subject, name, partial(subject.request, name))


@driving("protocol.md#times")
async def obeys_in_time(subject: Subject) -> None:
    """Requests that arm, feed, play or silence: each reply begins within 10 ms.

    Reply before slow work: do not wait for the high voltage, for a block of samples or for a ramp
    to end.
    """
    watchdog = subject.can["watchdog_max"]
    rejected = send("Ping", session=77, code="WRONG_SESSION")
    requests: dict[str, Callable[[], Awaitable[object]]] = {
        "refusals": partial(subject.send, rejected),
        "Arm": partial(subject.request, "Arm", watchdog=watchdog),
        "Ping": subject.ping,
        "Set": partial(subject.send, stage(subject.layer_0())),
        "Commit": lambda: subject.request("Commit", token=subject.sets.token),
        "GetAchieved": partial(subject.request, "GetAchieved", layer=0),
        "Silence": partial(subject.request, "Silence", ramp=0),
        "Disarm": partial(subject.request, "Disarm", ramp=0),
        "Stop": partial(subject.request, "Stop", ramp=0),
    }
    await subject.arm(watchdog / 1000)
    for name, request in requests.items():
        await _expect_prompt(subject, name, request)


async def _expect_prompt(
    subject: Subject, name: str, request: Callable[[], Awaitable[object]]
) -> None:
    """Repeat a request until a reply begins in time; raise ContractViolation if none does."""
    reactions = subject.client.lateness.reactions
    reactions[name].clear()  # so that earlier, slower exchanges do not count
    fastest = math.inf
    for _ in range(_TRIES):
        await request()
        fastest = min(reactions[name])
        if fastest <= REACTION:
            break
    quantity = f"shortest time until the reply to {name} begins [ms], of {_TRIES}"
    expect_within(1e3 * fastest, 0, 1e3 * REACTION, quantity)


@reading("protocol.md#order-of-checks")
async def unknown_types(subject: Subject) -> None:
    """Unknown message, or message of a feature that is not stated: UNKNOWN_TYPE.

    Check the type before the length. Reject every number that is not in the table, including 16 to
    18.
    """
    for number in UNKNOWN_NUMBERS:
        reply = await subject.client.exchange(number, ())
        expect_equal(reply.code, "UNKNOWN_TYPE", f"code for message {number}")
    for name, feature in _FEATURES.items():
        if not subject.has(feature):
            await subject.run([send(name, raw=valid_words(name), code="UNKNOWN_TYPE")])


@driving("protocol.md#order-of-checks")
def lengths(subject: Subject) -> RequestRows:
    """Request one word short or one word long: BAD_LENGTH.

    Read the words in order and reject at the first error: a missing word, a token of 0, a number
    out of range. Reject extra words only after that.
    """
    names = [name for name in MESSAGES if subject.has(_FEATURES.get(name, ""))]
    rows = []
    for name in names:
        words = valid_words(name)
        if words:
            rows.append(send(name, raw=words[:-1], code="BAD_LENGTH"))
    for name in names:
        if name != "Set":
            rows.append(send(name, raw=[*valid_words(name), 0], code="BAD_LENGTH"))
    # The invalid session is the first error.
    rows.append(send("Ping", raw=[0], code="BAD_VALUE"))
    rows.append(send("Ping", raw=[0, 0, 0], code="BAD_VALUE"))
    return [partial(subject.send_all, batch) for batch in in_batches(rows, _BATCH)]
