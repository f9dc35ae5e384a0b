"""What touches mean at the moment, exchangeable while the control loop runs."""

from collections.abc import Sequence

from controller.contacts import Contact
from controller.wishes import NewestBuzzes, Wish, Wishes


class Meaning:
    """Asks whatever touches mean now; every touch buzzes where it is unless told otherwise."""

    def __init__(self, level_db_sl: float) -> None:
        self._wishes: Wishes = NewestBuzzes(level_db_sl)

    def wish(self, contacts: Sequence[Contact], now: float) -> Wish:
        """As `Wishes`."""
        return self._wishes.wish(contacts, now)

    def exchange(self, wishes: Wishes) -> None:
        """From the next change of contacts on, touches mean this."""
        self._wishes = wishes
