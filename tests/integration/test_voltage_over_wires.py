"""Amplifiers of voltage over every wire of the protocol, in virtual time."""

import random

import numpy as np
import pytest

from drivers import clock
from drivers.amplifier import Amplifier
from drivers.command import CommandSet, DriveCommand, Envelope, Knot
from drivers.guard import Guard
from drivers.operation.checked_amplifier import CheckedAmplifier
from drivers.operation.keep_alive import keep_alive
from drivers.registry import open_backend
from long_form import shortly
from memory_machine import live_in_memory
from paper_table import smooth_rig
from sim.amplifier.sensor_messages import SensedAmplifier
from sim.bench.bench import Bench
from sim.bench.simulated_device import SimulatedDevice
from sim.far_ends.wires import Wire, open_wires
from virtual_loop import run_virtual
from voltage_rigs import LAWS, RESONANCES, resonator, voltage_rig

TONES = (DriveCommand(0, 120.0, 0.5, 30.0), DriveCommand(2, 120.0, 0.25, -110.0))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "kind",
    shortly(["serial", "modbus-tcp", "modbus-rtu", "socketcand", "slcan"], ["serial", "slcan"]),
)
def test_voltage_over_a_wire(kind: str, law: str) -> None:
    """A set, an onset where there are any, heartbeats that are compared, and the voltage itself.

    Its amplitude by the resonator's formula and the law, within two steps of the wire.
    """
    rig = voltage_rig(smooth_rig(), law)
    _, bias, gain = LAWS[law]

    async def play() -> None:
        live_in_memory()
        bench = Bench(rig, now=clock.now(), make_amplifier=SensedAmplifier)
        device = SimulatedDevice(bench, "main")
        async with open_wires({"main": Wire(kind)}, [device]) as urls:
            amplifier = Amplifier(open_backend(urls["main"], rig.voltage_of("main")))
            await amplifier.open()
            checked = CheckedAmplifier(amplifier)
            await checked.arm()
            guard = Guard(rig.limits, amplifier.capabilities)
            onset = 0
            if amplifier.capabilities.envelope_knots:
                shape = Envelope(1, 0.005, (Knot(0.1, 0.0), Knot(0.3, 40.0)))
                await amplifier.load_envelope(guard.check_envelope(shape))
                onset = 1
            first = DriveCommand(0, 120.0, 0.5, 30.0, onset=onset)
            token = amplifier.next_token()
            asked = CommandSet(token, (first, TONES[1]), ramp=0.02, valid_for=0.0)
            await checked.apply(guard.check(asked))
            await keep_alive(checked, 0.5)
            status = await amplifier.status()
            assert status.levels == pytest.approx((0.5, 0.0, 0.25, 0.0), abs=2e-3)
            for command, name in zip(TONES, ("SW", "NE"), strict=True):
                force = command.level / abs(resonator(np.array([120.0]), RESONANCES[name], gain)[0])
                voltage = {
                    "linear": force,
                    "quadratic": np.sqrt(2 * force),
                    "quadratic with bias": force / (2 * bias) if bias else 0.0,
                }[law]
                (tone,) = bench.amplifiers["main"].outputs[command.channel]
                assert abs(tone.settled_amplitude) == pytest.approx(voltage, abs=2e-4)
                assert tone.frequency == (60.0 if law == "quadratic" else 120.0)
            await amplifier.disarm()
            await amplifier.close()

    run_virtual(play(), rng=random.Random(1))
