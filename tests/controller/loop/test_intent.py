"""The default intent: the newest contact buzzes."""

import math

import pytest

from controller.loop.intent import NO_CONTACTS, BuzzNewestContact, HapticIntent, Target
from controller.sources.contacts import Contact, ContactKey


def at(id: int) -> Contact:
    """A contact."""
    return Contact(ContactKey("a", id), 0.1, 0.1, since=0.0)


def wanted(source: BuzzNewestContact, *ids: int) -> list[int]:
    """Which of these contacts shall feel something."""
    intent = source.intent(tuple(at(id) for id in ids), 0.0)
    return [target.key.id for target in intent.targets]


@pytest.mark.parametrize(
    ("steps", "targets"),
    [
        ([(1,), (1, 2, 3)], [[1], [3]]),  # the newest
        ([(1, 2), (1,), (1,), (1, 3)], [[2], [], [], [3]]),  # silent until the next contact comes
        ([(1, 2), (1,), (1, 2)], [[2], [], [2]]),  # one that comes back under its id is new
        ([(1, 2), (2,), ()], [[2], [2], []]),  # another one's lift changes nothing
    ],
)
def test_newest_buzzes_targets_the_newest_contact(
    steps: list[tuple[int, ...]], targets: list[list[int]]
) -> None:
    """Step by step."""
    source = BuzzNewestContact()
    assert [wanted(source, *ids) for ids in steps] == targets


def test_newest_buzzes_keeps_its_level() -> None:
    """None means as strong as the neighbours allow; the intent does not expire."""
    for level in (17.0, None):
        intent = BuzzNewestContact(level).intent((at(1),), 0.0)
        assert intent.targets == (Target(ContactKey("a", 1), level),)
        assert intent.until is None


def test_newest_buzzes_gives_a_reason_for_no_target() -> None:
    """After a lift another reason than on an empty plate."""
    source = BuzzNewestContact()
    assert source.intent((), 0.0).reason == NO_CONTACTS
    source.intent((at(1), at(2)), 0.0)
    assert source.intent((at(1),), 0.0).reason == "the target was lifted"
    assert source.intent((), 0.0).reason == NO_CONTACTS


@pytest.mark.parametrize(
    ("until", "due"), [(None, None), (7.0, 7.0), (3.0, 5.001), (math.nan, 5.001)]
)
def test_due_of_an_expired_intent_is_later(until: float | None, due: float | None) -> None:
    """So that it does not keep the loop busy."""
    assert HapticIntent((), until=until).due(5.0) == due
