"""Coming back after a loss: attempt by attempt, each from a closed controller."""

from controller.daemon.reconnect import reconnect
from drivers.errors import LinkError
from virtual_loop import in_virtual_time


class Controller:
    """One whose amplifiers answer, but are lost again before the first of them is disarmed."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    async def open(self) -> None:
        """Always succeeds."""
        self.asked.append("open")

    async def disarm(self) -> None:
        """Fails the first time."""
        self.asked.append("disarm")
        if self.asked.count("disarm") == 1:
            raise LinkError("the cable is loose")

    async def close(self) -> None:
        """Always succeeds."""
        self.asked.append("close")


@in_virtual_time
async def test_what_was_opened_and_not_disarmed_is_closed_before_it_is_tried_again() -> None:
    """Nothing stays open that may be armed, and each attempt is told."""
    controller, told = Controller(), []
    done = await reconnect(
        controller,  # type: ignore[arg-type]
        is_wanted=lambda: True,
        report=lambda event, message: told.append(event),
        alive=lambda: None,
    )
    assert done
    assert controller.asked == ["close", "open", "disarm", "close", "open", "disarm"]
    assert told == ["retry", "reopened"]
