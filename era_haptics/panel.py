"""A simulated panel for studies: plate, amplifiers, daemon and client in one `with` block.

Time is virtual: it passes only during calls of the client, so a program that waits for a person's
answer loses nothing, and a study without a person takes as long as its computations.
"""

import asyncio
from collections.abc import AsyncIterator, Iterator, Mapping
from contextlib import (
    AbstractContextManager,
    ExitStack,
    asynccontextmanager,
    contextmanager,
)
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from controller.api.client import AsyncClient, Client
from controller.daemon.daemon import Daemon
from controller.demo.demonstration import log_errors_only, on_simulated_plate, wait_until_ready
from controller.demo.simulated_plate import (
    SIMULATED_WATCHDOG,
    FingerVibration,
    SimulatedPlate,
)
from controller.demo.touch_rows import position_of, sensor_id
from controller.play.reports import Observers
from controller.process.log import LogThread
from controller.sources.touch import Change, Contact
from era_haptics.drive import expect_rig
from model.errors import expect_instance
from model.rig.rig import Rig
from model.rig.rig_writing import save_rig
from model.table.table_file import cached_table
from registry.service_manager import ServiceManager
from registry.virtual_time import VirtualLoopRunner

_TIMEOUT = 60.0  # virtual s; of a request
_NOTHING_PLAYS: Mapping[str, Any] = {"elsewhere": None}


class SimulatedPanel:
    """A plate with fingers on it, and a client of its daemon; `simulated_panel` makes it."""

    def __init__(self, client: Client, plate: SimulatedPlate, loop: VirtualLoopRunner) -> None:
        self.client = client
        """Client of the daemon."""
        self._plate = plate
        self._loop = loop

    def felt(self, since_s: float, until_s: float) -> list[FingerVibration]:
        """Return the vibration of all fingers between two times [s], in order of arrival.

        The times must have passed, and all fingers rested meanwhile; at least 0.2 s give the
        amplitude of each tone.
        """
        contacts = self.client.status().contacts
        vibration = self._loop.run(self._plate.vibration(since_s, until_s))
        return [vibration[f"{contact.source}#{contact.id}"] for contact in contacts]


class _Fingertips:
    """Places a fingertip on the simulated plate for each contact of the daemon."""

    def __init__(self, plate: SimulatedPlate) -> None:
        self._plate = plate
        self._placing: set[asyncio.Task[None]] = set()

    def observe(self, loop: Observers) -> None:
        """Follow the contacts of a control loop."""
        loop.contacts_changed.append(self._place)

    def _place(self, contacts: tuple[Contact, ...], change: Change) -> None:
        positions = {sensor_id(contact): position_of(contact) for contact in contacts}
        loads = {sensor_id(contact): contact.load for contact in contacts}
        placing = asyncio.create_task(self._plate.place_fingers(positions, loads))
        self._placing.add(placing)
        placing.add_done_callback(self._placing.discard)


def simulated_panel(
    rig: Rig, *, seed: int | None = None, layout: Mapping[str, Any] | None = None
) -> AbstractContextManager[SimulatedPanel]:
    """Run a daemon of a rig over simulated amplifiers for the duration of a `with` block.

    - seed: of a plate within the rig's tolerances; None for the rig's own plate.
    - layout: content of a layout file; by default nothing plays until `client.play`.

    Time is virtual, and passes only during calls of the client: wait with `client.sleep`. Raises
    InputError and LinkError.

    Example:
        >>> with era.simulated_panel(rig) as panel:
        ...     client = panel.client
        ...     with client.resting([(0.08, 0.06), (0.22, 0.16)]), client.armed("study"):
        ...         played = client.play([(0, 1, 0.5), (1, 1, 0.5)], (0.08, 0.06))
        ...         client.sleep(1)
        ...         own, other = panel.felt(played.start_s + 0.5, played.start_s + 0.9)
    """
    expect_rig(rig)
    if seed is not None:
        expect_instance(seed, int, what="seed", made_by="1, or None for the rig's own plate")
    if layout is not None:
        expect_instance(layout, Mapping, what="layout", made_by='{"elsewhere": None}')
    return _running_panel(rig, seed, layout or _NOTHING_PLAYS)


@contextmanager
def _running_panel(
    rig: Rig, seed: int | None, layout: Mapping[str, Any]
) -> Iterator[SimulatedPanel]:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="era-")))
        rig_file = folder / "panel.yaml"
        save_rig(rig, rig_file)
        loop = VirtualLoopRunner()
        stack.callback(loop.close)
        serving = _served(rig, rig_file, seed, layout)
        async_client, plate = loop.run(_entered(serving))
        stack.push(lambda *error: loop.run(serving.__aexit__(*error)))
        yield SimulatedPanel(Client(async_client, loop), plate, loop)


async def _entered(context: Any) -> Any:
    return await context.__aenter__()


@asynccontextmanager
async def _served(
    rig: Rig, rig_file: Path, seed: int | None, layout: Mapping[str, Any]
) -> AsyncIterator[tuple[AsyncClient, SimulatedPlate]]:
    """Serve a rig in this event loop; yields a client and the plate."""
    table, _ = cached_table(rig, drive_mode="phased")
    simulated = on_simulated_plate(
        rig_file, {"socket": "era.sock"}, layouts=[layout], wire="sim", seed=seed
    )
    with log_errors_only():
        async with simulated as (config, lock, plate):
            daemon = Daemon(
                config,
                table,
                log=LogThread(None),
                manager=ServiceManager({}),
                dashboard=None,
                observe=_Fingertips(plate).observe,
                watchdog=SIMULATED_WATCHDOG,
                handles_signals=False,
            )
            running = asyncio.create_task(daemon.run(lock), name="daemon")
            starting = asyncio.create_task(daemon.started.wait())
            await asyncio.wait({running, starting}, return_when=asyncio.FIRST_COMPLETED)
            starting.cancel()
            try:
                if not running.done():
                    connecting = AsyncClient.connect(config.socket, name="study", timeout=_TIMEOUT)
                    async with await connecting as client:
                        await wait_until_ready(client)
                        yield client, plate
            finally:
                daemon.shut_down("the panel is closed")
                await running
