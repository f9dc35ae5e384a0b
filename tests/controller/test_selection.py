"""Who is the target, and when a pattern is chosen anew."""

from collections.abc import Sequence

import pytest

from controller.contacts import Contact, ContactKey
from controller.selection import Selection, Selector
from model.errors import InputError
from model.excitation import Tone
from model.pattern import Pattern


class Table:
    """A table that remembers what it was asked, and refuses targets left of `refuse_below`."""

    def __init__(self, refuse_below: float = 0.0) -> None:
        self.asked: list[tuple[tuple[float, float], list[tuple[float, float]], float]] = []
        self.refuse_below = refuse_below

    def answer(
        self,
        target: tuple[float, float],
        *,
        quiet: Sequence[tuple[float, float]] = (),
        level_db_sl: float = 0.0,
    ) -> Pattern:
        """A pattern that names its question."""
        self.asked.append((target, list(quiet), level_db_sl))
        if target[0] < self.refuse_below:
            raise InputError("nothing is felt there")
        return Pattern({"SW": Tone(100.0 + len(self.asked), 1e-6)}, 0.02, level_db_sl, None, None)


def at(id: int, x: float, y: float = 0.1) -> Contact:
    """A contact."""
    return Contact(ContactKey("a", id), x, y, since=0.0)


def target_id(selection: Selection) -> int | None:
    """Whose pattern it is."""
    return selection.target.key.id if selection.target else None


@pytest.fixture
def table() -> Table:
    """A table that refuses nothing."""
    return Table()


def test_the_newest_is_the_target(table: Table) -> None:
    """The newest contact is asked for at the wanted level with all others as quiet zone."""
    selector = Selector(table, level_db_sl=17.0)
    assert target_id(selector.select((at(1, 0.1),))) == 1
    selection = selector.select((at(1, 0.1), at(2, 0.2), at(3, 0.3)))
    assert target_id(selection) == 3
    assert table.asked == [
        ((0.1, 0.1), [], 17.0),
        ((0.3, 0.1), [(0.1, 0.1), (0.2, 0.1)], 17.0),
    ]


def test_nobody(table: Table) -> None:
    """Without contacts nothing is asked and nothing felt."""
    selection = Selector(table).select(())
    assert (selection.target, selection.pattern) == (None, None)
    assert selection.reason == "nobody touches the plate"
    assert table.asked == []


def test_target_lifts_while_others_stay(table: Table) -> None:
    """All is silent until the next contact comes, whatever the ones that stay do."""
    selector = Selector(table)
    selector.select((at(1, 0.1), at(2, 0.2)))
    for contacts in [(at(1, 0.1),), (at(1, 0.29),)]:
        selection = selector.select(contacts)
        assert selection.pattern is None
        assert selection.reason == "the target was lifted"
    assert target_id(selector.select((at(1, 0.29), at(3, 0.2)))) == 3
    assert len(table.asked) == 2


def test_lift_of_all_is_told_as_such(table: Table) -> None:
    """After the last finger the reason is that nobody is there."""
    selector = Selector(table)
    selector.select((at(1, 0.1), at(2, 0.2)))
    selector.select((at(1, 0.1),))
    assert selector.select(()).reason == "nobody touches the plate"


def test_the_same_finger_again(table: Table) -> None:
    """A finger that comes back under its old id after a lift is a new contact."""
    selector = Selector(table)
    selector.select((at(1, 0.1), at(2, 0.2)))
    selector.select((at(1, 0.1),))
    assert target_id(selector.select((at(1, 0.1), at(2, 0.2)))) == 2


@pytest.mark.parametrize("mover", [0, 1])
def test_moves(table: Table, mover: int) -> None:
    """Up to 8 mm from where the pattern was chosen it stays, beyond it is chosen anew.

    It is the way from there that counts, not from the frame before, and of any contact.
    """
    selector = Selector(table)

    def contacts(distance: float) -> tuple[Contact, ...]:
        moved = [0.0, 0.0]
        moved[mover] = distance
        return (at(1, 0.1, 0.1 + moved[0]), at(2, 0.2, 0.1 - moved[1]))

    first = selector.select(contacts(0.0))
    assert selector.select(contacts(0.004)) is first
    assert selector.select(contacts(0.0079)) is first
    second = selector.select(contacts(0.0081))
    assert second.pattern != first.pattern
    assert selector.select(contacts(0.0)) is not second


def test_a_quiet_contact_that_lifts_changes_nothing(table: Table) -> None:
    """The target goes on feeling the same."""
    selector = Selector(table)
    first = selector.select((at(1, 0.1), at(2, 0.2)))
    assert selector.select((at(2, 0.2),)) is first


def test_refused_by_the_table() -> None:
    """A table's refusal is silence with its words, asked again when it may have changed."""
    table = Table(refuse_below=0.2)
    selector = Selector(table)
    refused = selector.select((at(1, 0.25), at(2, 0.1)))
    assert (target_id(refused), refused.pattern, refused.reason) == (
        2,
        None,
        "nothing is felt there",
    )
    assert selector.select((at(1, 0.25), at(2, 0.1))) is refused
    assert len(table.asked) == 1
    assert selector.select((at(2, 0.1),)).reason == "nothing is felt there"
    assert len(table.asked) == 2  # without the quiet contact it might have been possible
    assert selector.select((at(2, 0.21),)).pattern is not None
