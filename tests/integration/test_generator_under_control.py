"""A control loop over a signal generator, over TCP: touches, another frequency, a lift."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import replace
from importlib import util
from pathlib import Path

import numpy as np
import pytest

from controller.loop.intent import HapticIntent, Target
from controller.loop.loop import Controller
from controller.loop.observer import Applied, Observer
from controller.sources.contacts import Contact
from controller.sources.touch import Touch, TouchFrame
from drivers import clock
from drivers.amplifier import Amplifier
from drivers.errors import CommandError
from drivers.voltage import VoltageBackend
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.table.build import build_table
from model.table.table import LocalizationTable
from model.table.timing import Timing
from registry.voltage import Law
from scpi_generator import Generator, on_tcp

FOLDER = Path(__file__).parents[2] / "examples" / "plugins" / "scpi"
FINGER, OTHER = Touch(1, 0.3, 0.3), Touch(2, 0.7, 0.7)
BANDS = ((100.0, 100.0), (180.0, 180.0))


class InBand:
    """The first contact feels 15 dB SL in a band."""

    def __init__(self) -> None:
        self.band = BANDS[0]

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """One target, wherever it is."""
        if not contacts:
            return HapticIntent(())
        return HapticIntent((Target(contacts[0].key, level_db_sl=15.0, band=self.band),))


@pytest.fixture(scope="module")
def rig() -> Rig:
    """The example's rig on a coarse mesh."""
    return load_rig(FOLDER / "rig.yaml", mesh="16x12")


@pytest.fixture(scope="module")
def table(rig: Rig) -> LocalizationTable:
    """Its table at two frequencies."""
    return build_table(rig, frequencies=np.array([100.0, 180.0]))


@asynccontextmanager
async def controlled(
    rig: Rig, table: LocalizationTable, generator: Generator, *, is_supervised: bool
) -> AsyncIterator[tuple[Controller, InBand, list[Applied], list[str]]]:
    """A controller over the generator, not yet open; what it applied, and what was refused."""
    spec = util.spec_from_file_location("scpi_backend", FOLDER / "scpi_backend.py")
    assert spec is not None
    assert spec.loader is not None
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    async with on_tcp(generator) as port:
        backend = module.ScpiBackend(f"scpi://127.0.0.1:{port}")
        amplifier = Amplifier(VoltageBackend(backend, rig.voltage_of("generator")))
        source, applied, refused = InBand(), list[Applied](), list[str]()
        yield (
            Controller(
                rig,
                table,
                amplifiers={"generator": amplifier},
                intent_source=source,
                observer=Observer(pattern_applied=applied.append, refused=refused.append),
                timing=Timing(table),
                is_supervised=is_supervised,
            ),
            source,
            applied,
            refused,
        )


async def held(controller: Controller, *touches: Touch, until: Callable[[], bool]) -> None:
    """Repeat a frame until something holds."""
    async with asyncio.timeout(60):
        while not until():
            controller.deliver(TouchFrame("test", clock.now(), touches))
            await asyncio.sleep(0.02)


async def test_generator_must_be_supervised(rig: Rig, table: LocalizationTable) -> None:
    """Nothing ends its vibrations when the host has died."""
    async with controlled(rig, table, Generator(), is_supervised=False) as (controller, *_):
        with pytest.raises(CommandError, match="supervised"):
            await controller.open()


async def test_touches_play_two_channels_in_phase(rig: Rig, table: LocalizationTable) -> None:
    """The pattern's frequency, halved; another one after silence; a lift switches outputs off."""
    generator = Generator()
    async with controlled(rig, table, generator, is_supervised=True) as found:
        controller, source, applied, refused = found
        await controller.open()
        assert controller.drive_mode == "phased"
        await controller.arm()
        running = asyncio.create_task(controller.run())
        await held(controller, FINGER, until=lambda: len(applied) == 1)
        assert {output.frequency for output in generator.outputs if output.is_on} == {50.0}
        assert generator.outputs[0].origin == generator.outputs[1].origin
        source.band = BANDS[1]
        before = len(generator.log)
        await held(controller, FINGER, OTHER, until=lambda: len(applied) == 2)
        assert {output.frequency for output in generator.outputs if output.is_on} == {90.0}
        lines = generator.log[before:]
        changed = next(number for number, line in enumerate(lines) if "FREQ 90" in line)
        off = next(number for number, line in enumerate(lines) if ":OUTP1 OFF;:OUTP2 OFF" in line)
        assert off < changed
        await held(controller, until=lambda: not any(output.is_on for output in generator.outputs))
        await controller.close()
        await running
    assert refused == []
    assert not generator.errors
    assert applied[-1].timing is None  # transients of a squared ramp are not predicted
    pattern = applied[-1].pattern
    assert pattern.ramp == 0.0
    assert set(pattern.excitation) == {"SW", "NE"}


async def test_onset_of_an_actuator_is_not_predicted(rig: Rig, table: LocalizationTable) -> None:
    """A linear law follows a ramp only as fast as the actuator does."""
    drives = {name: replace(drive, law=Law.LINEAR) for name, drive in rig.voltage.items()}
    linear = replace(rig, voltage=drives)
    async with controlled(linear, table, Generator(), is_supervised=True) as found:
        controller, _, applied, _ = found
        await controller.open()
        await controller.arm()
        running = asyncio.create_task(controller.run())
        await held(controller, FINGER, until=lambda: len(applied) == 1)
        await controller.close()
        await running
    assert applied[0].timing is None
