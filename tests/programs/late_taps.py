"""Taps by the thousand while every frame is late: no amplifier may be taken for faulty.

    python tests/programs/late_taps.py [--taps N] [--first SEED]

One and three amplifiers on one line of each kind, in virtual time. What passes a line is late by up
to 16 ms either way, at random, as behind a USB adapter with its latency timer; some frames come
twice. A finger taps and feels a click of 5 to 40 ms, often beside one that rests and feels a
vibration; now and then all is disarmed or stopped, and armed again.
"""

import argparse
import asyncio
import logging
import math
import random
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from controller.play.intent import HapticIntent, Pulse, Target
from controller.sources.touch import Contact, ContactKey
from drivers.errors import DriverError
from kit.chain import Chain
from kit.clock import run_virtual
from kit.set_table import SetTable, make_rig
from model.rig.rig import Channel
from model.vibration import Tone
from registry.limits import GuardLimits
from sim.far_ends.wire_assignment import SimulatedWire
from sim.faults import FaultWindow

WIRES: Mapping[str, SimulatedWire] = {
    "serial": SimulatedWire("serial", 921_600, shared=True),
    "modbus": SimulatedWire("modbus-rtu", 115_200),
    "can": SimulatedWire("slcan", 500_000),
}
AMPLIFIERS = (1, 3)
LATEST = 0.016  # s
PER_CHAIN = 50  # taps
COLUMNS = ("taps", "clicks", "played", "too late", "faults")
_CLICKS = (0.005, 0.040)  # s
_DOUBLED = 0.02  # share of frames
_RESTING = 1
_OPERATED = 0.02  # share of taps before which all is disarmed or stopped
_TRIES = 50


class Clicks:
    """A click for each finger that comes, but for the one that rests."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self.pulses: list[Pulse] = []
        """All clicks, in order."""
        self._pulses: dict[ContactKey, Pulse | None] = {}

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Target each finger while its click has not ended."""
        former_pulses, self._pulses = self._pulses, {}
        targets, ends = [], []
        for contact in contacts:
            if contact.key not in former_pulses and contact.key.id != _RESTING:
                self.pulses.append(Pulse(self._rng.uniform(*_CLICKS), now))
                former_pulses[contact.key] = self.pulses[-1]
            pulse = self._pulses[contact.key] = former_pulses.get(contact.key)
            if pulse is None or now < pulse.end:
                targets.append(Target(contact.key, pulse=pulse))
                ends.append(math.inf if pulse is None else pulse.end)
        return HapticIntent(tuple(targets), until=min(ends, default=math.inf))

    def has_effect_at(self, contact: Contact) -> bool:
        """Return True: every contact has one."""
        return True


def play(wire: str, amplifiers: int, seed: int, taps: int = PER_CHAIN) -> Counter[str]:
    """Tap on a plate with amplifiers on one line; count what `COLUMNS` names, and what is wrong."""
    rng, names = random.Random(seed), [f"a{number}" for number in range(amplifiers)]
    rig = make_rig(names, GuardLimits(40.0, 500.0, 1.0))
    wiring = {
        era: Channel(names[n % amplifiers], n // amplifiers) for n, era in enumerate(rig.wiring)
    }
    rig = replace(rig, wiring=wiring)
    table = SetTable({era: Tone(110.0, 20e-6, math.pi / 2) for era in wiring}, rig.plate)

    async def run() -> Counter[str]:
        clicks = Clicks(rng)
        async with Chain.on(WIRES[wire], rig, table, intent_source=clicks) as chain:
            chain.is_felt = chain.must_be_felt = False
            await chain.open()
            await _armed(chain)
            chain.host_rules.disturb()
            chain.operation.passing = (0.0, LATEST)
            for end in chain.far_ends:
                end.device.inject_fault(FaultWindow(fault="duplicate", share=_DOUBLED))
            counts = Counter[str](taps=taps)
            for finger in range(_RESTING + 1, _RESTING + 1 + taps):
                if rng.random() < _OPERATED:
                    with suppress(DriverError):
                        await chain.operate(rng.choice(("disarm", "stop")))
                elif not chain.controller.group.is_armed:
                    counts["faults"] += 1
                    counts[f"{wire}, {amplifiers}, seed {seed}: {chain.refused + chain.lost}"] += 1
                await _armed(chain)
                at = rng.uniform(0.02, 0.28), rng.uniform(0.02, 0.18)
                rests = [(_RESTING, 0.05, 0.05)] if rng.random() < 0.5 else []
                await chain.hold(rng.uniform(0.02, 0.12), down=[*rests, (finger, *at)])
                chain.put(*rests)
                await asyncio.sleep(rng.uniform(0.02, 0.12))
            await asyncio.sleep(0.2)  # until the last click is over
            outcomes = await chain.controller.stop()
            for name, outcome in outcomes.items():
                if outcome.is_confirmed and chain.plate_judge.loudest(name, 1.0, 20) > 0:
                    counts[f"{wire}, {amplifiers}, seed {seed}: {name} is not silent"] += 1
            counts["clicks"] = len(clicks.pulses)
            counts["played"] = sum(pulse.started_at is not None for pulse in clicks.pulses)
            counts["too late"] = chain.controller.cycle.clicks_too_late
            await chain.close()
            violations = chain.plate_judge.violations
            counts.update(
                f"{wire}, {amplifiers}, seed {seed}: {violation}" for violation in violations
            )
            return counts

    return run_virtual(run(), rng=random.Random(seed + 1))


async def _armed(chain: Chain) -> None:
    """Open what was lost, clear and arm, until that succeeds."""
    for _ in range(_TRIES):
        if chain.controller.group.is_armed:
            return
        with suppress(DriverError):
            if not chain.controller.group.is_open:
                await chain.controller.release()
                await chain.controller.open()
            await chain.operate("clear")  # also of a late copy of a stop
            await chain.operate("arm")
        await asyncio.sleep(0.05)
    raise TimeoutError("could not be armed")


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--taps", type=int, default=10_000, help="on all wires together")
    parser.add_argument("--first", type=int, default=0, help="the first seed of each")
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    kinds = [(wire, count) for wire in WIRES for count in AMPLIFIERS]
    chains = math.ceil(options.taps / len(kinds) / PER_CHAIN)
    wrong = 0
    sys.stdout.write(f"{'':<22}" + "".join(f"{name:>12}" for name in COLUMNS) + "\n")
    for wire, amplifiers in kinds:
        counts = Counter[str]()
        for seed in range(options.first, options.first + chains):
            counts += play(wire, amplifiers, seed)
        row = "".join(f"{counts.pop(name, 0):>12}" for name in COLUMNS)
        sys.stdout.write("\n".join((f"{wire + f', {amplifiers}':<22}{row}", *counts)) + "\n")
        sys.stdout.flush()
        wrong += sum(counts.values())
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
