"""Reconnection after a loss: each attempt starts from a closed controller."""

from controller.daemon.reconnect import reconnect
from drivers.errors import LinkError
from virtual_loop import in_virtual_time


class Controller:
    """A controller whose amplifiers are lost again before the first is disarmed."""

    def __init__(self) -> None:
        self.calls: list[str] = []

    async def open(self) -> None:
        """Always succeeds."""
        self.calls.append("open")

    async def disarm(self) -> None:
        """Fails the first time."""
        self.calls.append("disarm")
        if self.calls.count("disarm") == 1:
            raise LinkError("injected")

    async def close(self) -> None:
        """Always succeeds."""
        self.calls.append("close")


@in_virtual_time
async def test_reconnect_closes_amplifiers_that_could_not_be_disarmed() -> None:
    """None that may be armed stays open, and each attempt is reported."""
    controller, reports = Controller(), []
    done = await reconnect(
        controller,
        should_continue=lambda: True,
        report=lambda event, message: reports.append(event),
        alive=lambda: None,
    )
    assert done
    assert controller.calls == ["close", "open", "disarm", "close", "open", "disarm"]
    assert reports == ["retry", "reopened"]
