"""Checks of damaged and repeated frames on every wire."""

from drivers.protocol.definition import MESSAGES
from era_haptics.lab.conformance.check import driving
from era_haptics.lab.conformance.outcomes import verify
from era_haptics.lab.conformance.request_rows import Wait, layer
from era_haptics.lab.conformance.subject import Subject
from registry import threads

_PING, _SET = MESSAGES["Ping"].number, MESSAGES["Set"].number


@driving("protocol.md#order-of-checks")
async def damaged_frames(subject: Subject) -> None:
    """Damaged frame, or frame for another address: no reply, no effect, does not feed.

    Check length, checksum and address before anything else, and discard the frame silently.
    """
    client = subject.client
    await client.look_around()
    if client.kind == "serial":
        await _expect_one_address(subject)
    await subject.arm()
    await subject.play(subject.layer_0())
    _, words = subject.words_of(layer(0, subject.tone(0, 0.5)))
    for number, sent_words in ((_PING, [subject.session, 0]), (_SET, words)):
        for description, data in client.damaged(number, sent_words):
            await subject.unfed()
            await client.expect_silence(data, f"message {number} with {description}")
            await subject.request("GetStatus")


async def _expect_one_address(subject: Subject) -> None:
    """Raise ContractViolation if the amplifier replies at the address of a neighbor."""
    client = subject.client
    own_address = client.address
    for address in client.neighbors:
        client.address = address
        identity = await client.hello()
        is_other = identity != subject.identity
        quantity = "address of this amplifier"
        verify(is_other, quantity, expected=own_address, actual=address)
    client.address = own_address


@driving("protocol.md#sets")
async def doubled_frames(subject: Subject) -> None:
    """Frame that arrives twice or late: treated as a repetition of its token.

    Decide by the token whether a set is new, not by the sequence number of the frame.
    """
    client = subject.client
    await subject.arm()
    quiet, loud = (layer(0, subject.tone(0, level), valid_for=250) for level in (0.5, 1.0))
    quiet_part, quiet_words = subject.words_of(quiet)
    loud_part, loud_words = subject.words_of(loud)
    quiet_frame = client.request(_SET, quiet_words)
    loud_frame = client.request(_SET, loud_words)
    for part, frame in ((quiet_part, quiet_frame), (loud_part, loud_frame)):
        sent_at = threads.now()
        await client.reply_to(frame)
        subject.played(part, sent_at)
    for frame, pause in ((quiet_frame, 0.0), (loud_frame, 0.25), (loud_frame, 0.0)):
        await client.reply_to(frame)
        await subject.run([subject.ping, Wait(pause)])
