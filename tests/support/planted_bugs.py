"""Bugs to plant into the running chain, each with the rule that the witness must find broken.

A bug is a change of the text of one function: what stands in the source is replaced and the
function made anew. Where the text is not there any more, planting it fails.
"""

import importlib
import inspect
import textwrap
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

import pytest

import witness_scenarios as scenarios
from witnessed_chain import Chain


@dataclass(frozen=True)
class Edit:
    """In a function (module:name or module:Class.name), this text becomes that.

    also: modules that have imported the function by its name.
    """

    where: str
    old: str
    new: str
    also: tuple[str, ...] = ()


@dataclass(frozen=True)
class Bug:
    """What is changed, the rule that it breaks, and where it is seen."""

    breaks: str
    edits: tuple[Edit, ...]
    scenario: Callable[[Chain], Awaitable[None]] = scenarios.day
    wire: str = "serial"
    amplifiers: tuple[str, ...] = ("main",)


def plant(bug: Bug, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change the code as the bug says, for as long as the monkeypatch lasts."""
    for edit in bug.edits:
        module_name, _, path = edit.where.partition(":")
        module = importlib.import_module(module_name)
        *owners, name = path.split(".")
        owner: Any = getattr(module, owners[0]) if owners else module
        if not hasattr(owner, name):
            raise LookupError(f"{edit.where} is not there any more")
        if edit.old == "":
            monkeypatch.setattr(owner, name, eval(edit.new, vars(module)))
            continue
        found = inspect.unwrap(
            getattr(inspect.getattr_static(owner, name), "fget", None) or getattr(owner, name)
        )
        source = textwrap.dedent(inspect.getsource(found))
        if edit.old not in source:
            raise LookupError(f"{edit.where} does not say {edit.old!r} any more")
        made: dict[str, Any] = {}
        code = compile(source.replace(edit.old, edit.new), f"<planted in {edit.where}>", "exec")
        exec(code, vars(module), made)
        monkeypatch.setattr(owner, name, made[name])
        for other in edit.also:
            monkeypatch.setattr(importlib.import_module(other), name, made[name])


def _bug(breaks: str, *edits: Edit, **where: Any) -> Bug:
    return Bug(breaks, edits, **where)


_TWO = ("a", "b")

_WITHOUT = "tuple(rule for rule in _RULES if rule is not {})"
_FAR = "sim.amplifier.amplifier:SimulatedAmplifier"

CONTROLLER: dict[str, Bug] = {
    "an up is dropped": _bug(
        "lift",
        Edit(
            "controller.sources.contacts:ContactTracker._lift",
            "self._contacts.pop(key) for key in tuple(keys)",
            "self._contacts[key] for key in tuple(keys)",
        ),
    ),
    "the lease of a source never ends": _bug(
        "lift",
        Edit("controller.sources.contacts:CONTACT_TIMEOUT", "", "2.0"),
        scenario=scenarios.source_dies,
    ),
    "channels are swapped in routing": _bug(
        "pattern",
        Edit(
            "controller.loop.routing:_drive",
            "number = rig.wiring[name].number",
            "number = (1, 0, 2)[rig.wiring[name].number]",
        ),
    ),
    "phases are sent in radians": _bug(
        "pattern",
        Edit("controller.loop.routing:_wrapped_degrees", "math.degrees(", "float("),
    ),
    "levels are of twice the stroke": _bug(
        "pattern",
        Edit(
            "controller.loop.routing:_drive", "rig.era(name).stroke", "(2 * rig.era(name).stroke)"
        ),
    ),
    "the pattern of the first finger stays": _bug(
        "touch",
        Edit(
            "controller.loop.selection:Selector._holds",
            "if not targets or not current.targets:",
            "if targets and current.targets:\n        return True\n    if not targets:",
        ),
    ),
    "fingers beside the plate count": _bug(
        "justified",
        Edit(
            "controller.sources.contacts:ContactTracker._places",
            "elif not (0 <= touch.x <= 1 and 0 <= touch.y <= 1):",
            "elif False:",
        ),
        scenario=scenarios.touched_beside,
    ),
    "the heartbeat comes from a timer": _bug(
        "heartbeat",
        Edit(
            "controller.loop.loop:Controller.step",
            "self._wake.clear()",
            """self._wake.clear()
    async def beat():
        while True:
            await asyncio.sleep(HEARTBEAT)
            await self._group.heartbeat()
    if not hasattr(self, "beating"):
        self.beating = asyncio.create_task(beat())""",
        ),
        scenario=scenarios.hung,
    ),
    "heartbeats are too rare": _bug("heartbeat", Edit("controller.loop.loop:HEARTBEAT", "", "0.2")),
    "heartbeats wait for touches": _bug(
        "heartbeat",
        Edit(
            "controller.loop.loop:Controller._next_cause",
            "moments.append(self._heartbeat_due)",
            "pass",
        ),
    ),
    "a stop reaches one amplifier only": _bug(
        "stop",
        Edit(
            "controller.group.quick_stops:QuickStops.request",
            "(*self._on_buses, *reachable)",
            "reachable[:1]",
        ),
        amplifiers=_TWO,
    ),
    "a set is committed by one amplifier only": _bug(
        "commit",
        Edit(
            "controller.group.synchronized_play:SynchronizedPlay._commits",
            "in together.items()",
            "in list(together.items())[:1]",
        ),
        Edit(
            "controller.group.synchronized_play:SynchronizedPlay.play",
            "if status.token != commands[name].token:",
            "if False:",
        ),
        amplifiers=_TWO,
    ),
    "it arms again once it is cleared": _bug(
        "armed",
        Edit(
            "controller.loop.loop:Controller.clear",
            "await self._group.clear()",
            "await self._group.clear(); await self._group.arm()",
        ),
        scenario=scenarios.arc,
    ),
    "fingers that are alone are not answered": _bug(
        "touch",
        Edit(
            "controller.loop.loop:Controller.step",
            "if self.phase is Phase.ARMED and (",
            "if self.phase is Phase.ARMED and len(decision.contacts) != 1 and (",
        ),
    ),
    "a touch does not wake the loop": _bug(
        "lift", Edit("controller.loop.loop:Controller._follow", "self._wake.set()", "pass")
    ),
    "the release takes half a second": _bug(
        "lift", Edit("controller.loop.decision:RELEASE_RAMP", "", "0.5")
    ),
    "what was played is not taken back": _bug(
        "lift",
        Edit("controller.loop.decision:Decider._ending", "if not contacts:", "if False:"),
        Edit("controller.loop.decision:FADE_RAMP", "", "0.3"),
    ),
}

DRIVERS: dict[str, Bug] = {
    "the frequency clamp is removed": _bug(
        "limits",
        Edit("drivers.guard.rules:_RULES", "", _WITHOUT.format("_check_frequencies")),
        scenario=scenarios.too_high,
    ),
    "the level clamp is removed": _bug(
        "limits",
        Edit("drivers.guard.rules:_RULES", "", _WITHOUT.format("_check_levels")),
        scenario=scenarios.too_loud,
    ),
    "the check for NaN is skipped": _bug(
        "garbage",
        Edit("drivers.guard.rules:_RULES", "", _WITHOUT.format("_check_finite")),
        Edit(
            "drivers.protocol.definition:Quantity.to_wire",
            "if not math.isfinite(value):",
            "if math.isnan(value):\n        return -0x8000\n    if False:",
        ),
        scenario=scenarios.not_a_number,
    ),
    "every set has the same token": _bug(
        "token",
        Edit(
            "drivers.protocol.definition:token_after",
            "token %",
            "0 *",
            also=("controller.loop.orders",),
        ),
    ),
    "levels have 1000 steps": _bug(
        "pattern",
        Edit(
            "drivers.codec.serial_line.sets:_pack_commands",
            "command.frequency, command.level,",
            "command.frequency, command.level / 10,",
        ),
    ),
    "integers are sent with the high byte first": _bug(
        "garbage",
        Edit(
            "drivers.codec.payload:_LAYOUTS",
            "",
            "{code: struct.Struct('>' + code) for code in 'BHIh'}",
        ),
    ),
    "the host does not check the CRC": _bug(
        "credit",
        Edit(
            "drivers.codec.serial_line.frame:FrameReader._finish",
            "if _CRC.unpack(crc) != (zlib.crc32(body),):",
            "if False:",
        ),
        scenario=scenarios.damaged_answer,
    ),
    "a reply is credited to whoever waits": _bug(
        "credit",
        Edit(
            "drivers.backends.serial_line.backend:SerialBackend._received",
            "self._pending.get(frame.sequence)",
            "next(iter(self._pending.values()), None)",
        ),
        scenario=scenarios.foreign_answer,
    ),
    "two requests are on the line at once": _bug(
        "credit",
        Edit("drivers.link.turns:Turns.come", "if self._taken or", "if False and"),
        scenario=scenarios.slow_touch,
    ),
    "a stop is queued behind": _bug(
        "stop",
        Edit("drivers.link.turns:PATIENCE", "", "10.0"),
        scenario=scenarios.slow_stop,
    ),
    "silence waits its turn": _bug(
        "lift",
        Edit("drivers.link.turns:PATIENCE", "", "10.0"),
        Edit("controller.group.amplifier_group:PATIENCE", "", "10.0"),
        scenario=scenarios.slow_lift,
    ),
    "a stop is sent as a disarm": _bug(
        "stop",
        Edit(
            "drivers.amplifier:Amplifier.stop",
            "Stop(ramp=self._ramp(ramp))",
            "Disarm(ramp=self._ramp(ramp))",
        ),
    ),
    "nobody is identified": _bug(
        "identified",
        Edit(
            "drivers.amplifier:Amplifier.open",
            "await self._link.ask(Hello(), expect=Identity, timeout=OPEN_TIMEOUT)",
            "Identity('', '', '', '', PROTOCOL.version)",
        ),
    ),
    "sets are sent without their SYNC": _bug(
        "answer",
        Edit(
            "drivers.codec.can_bus.requests:encode_request",
            "head, wanted.commands, node, sequence), SYNC)",
            "head, wanted.commands, node, sequence))",
            also=("drivers.backends.can_bus.backend",),
        ),
        wire="slcan",
    ),
    "a command has the sequence number before": _bug(
        "commit",
        Edit(
            "drivers.codec.can_bus.requests:_in_classic_frames",
            "_command(command, sequence))",
            "_command(command, sequence - (command.channel == 1)))",
        ),
        wire="socketcand",
    ),
    "the frame of a channel has its neighbour's identifier": _bug(
        "garbage",
        Edit(
            "drivers.codec.can_bus.requests:_in_classic_frames",
            "command_id(node, command.channel)",
            "command_id(node, (1, 0, 2)[command.channel])",
        ),
        wire="slcan",
    ),
    "a block carries a wrong check": _bug(
        "garbage",
        Edit(
            "drivers.codec.modbus.exchanges:_block",
            "check_of(registers)",
            "check_of(registers[1:])",
        ),
        wire="modbus-tcp",
    ),
    "registers of channels begin with the level": _bug(
        "limits",
        Edit(
            "drivers.codec.modbus.exchanges:_pack_channel",
            "*_unsigned(\n            (_Q.frequency, command.frequency),\n"
            "            (_Q.level, command.level),",
            "*_unsigned(\n            (_Q.level, command.level),\n"
            "            (_Q.frequency, command.frequency),",
        ),
        wire="modbus-rtu",
    ),
}

FAR_ENDS: dict[str, Bug] = {
    "the watchdog is 20 ms late": _bug(
        "watchdog",
        Edit(
            f"{_FAR}._watchdog_end",
            "self._fed + self._watchdog",
            "0.02 + self._fed + self._watchdog",
        ),
        scenario=scenarios.hung,
    ),
    "the watchdog is 20 ms early": _bug(
        "watchdog",
        Edit(
            f"{_FAR}._watchdog_end",
            "self._fed + self._watchdog",
            "self._fed + self._watchdog - 0.02",
        ),
        scenario=scenarios.hung,
    ),
    "there is no watchdog": _bug(
        "watchdog",
        Edit(f"{_FAR}._watchdog_end", "if self.state in ENABLED", "if False"),
        scenario=scenarios.hung,
    ),
    "looking on feeds the watchdog": _bug(
        "watchdog", Edit("sim.amplifier.amplifier:_NOT_FEEDING", "", "()"), scenario=scenarios.hung
    ),
    "the time left is told in hundredths": _bug(
        "watchdog",
        Edit(
            f"{_FAR}.status",
            "self._fed + self._watchdog - now",
            "0.1 * (self._fed + self._watchdog - now)",
        ),
    ),
    "a fault is not latched": _bug(
        "latched",
        Edit(f"{_FAR}.tick", "State.FAULT if silent", "State.SWITCH_ON_DISABLED if silent"),
        scenario=scenarios.arc,
    ),
    "a stop is not latched": _bug(
        "latched",
        Edit(
            f"{_FAR}._carry_out",
            "self._enter(following, now)\n            self.tick(now)",
            "self._enter(State.SWITCH_ON_DISABLED, now)\n            self.tick(now)",
        ),
    ),
    "it arms itself after a fault": _bug(
        "armed",
        Edit(f"{_FAR}.tick", "State.FAULT if silent", "State.OPERATION_ENABLED if silent"),
        scenario=scenarios.arc,
    ),
    "a commit is torn": _bug(
        "commit",
        Edit(
            "sim.amplifier.channels:Channels.play",
            "for channel, playing in enumerate(self._outputs):",
            "for channel, playing in list(enumerate(self._outputs))[:1]:",
        ),
    ),
    "channels are swapped in the amplifier": _bug(
        "plays",
        Edit(
            "sim.amplifier.channels:Channels.play",
            "commands.get(channel,",
            "commands.get((1, 0, 2)[channel],",
        ),
    ),
    "a ramp is ignored": _bug(
        "ramp", Edit("sim.amplifier.channels:Channels.play", "ramp=ramp,", "ramp=0.0,")
    ),
    "a stop is abrupt": _bug(
        "ramp", Edit("sim.amplifier.channels:Channels.silence", "ramp=ramp", "ramp=0.0")
    ),
    "a disarmed amplifier plays on": _bug(
        "silent",
        Edit(
            f"{_FAR}._carry_out",
            "self._silence(now, ramp=self._stopping_ramp(ramp))",
            "self._silent_from = now",
        ),
        scenario=scenarios.disarmed_amid,
    ),
    "a fault lets one channel play on": _bug(
        "silent",
        Edit(
            "sim.amplifier.channels:Channels.silence",
            "for output in self._outputs]",
            "for output in self._outputs[:1]] + self._outputs[1:]",
        ),
        scenario=scenarios.arc,
    ),
    "a stale set is played": _bug(
        "token",
        Edit("sim.amplifier.sets:Sets.stage", "if wanted.token in self.tokens:", "if False:"),
        scenario=scenarios.late_copy,
    ),
    "a damaged frame is carried out": _bug(
        "damage",
        Edit(
            "drivers.codec.serial_line.frame:FrameReader._finish",
            "if _CRC.unpack(crc) != (zlib.crc32(body),):",
            "if False:",
        ),
        scenario=scenarios.noise,
    ),
    "the high voltage stays on": _bug(
        "high_voltage",
        Edit(f"{_FAR}.status", "is_on = ", "is_on = self.state is State.FAULT or "),
        scenario=scenarios.arc,
    ),
    "every answer is sent twice": _bug(
        "credit",
        Edit(
            "sim.far_ends.serial_end:SerialEnd._to_host",
            "self._terminal.write(data)",
            "self._terminal.write(data); self._terminal.write(data)",
        ),
    ),
    "a request is left unanswered": _bug(
        "answer",
        Edit(
            "sim.far_ends.serial_end:SerialEnd._to_host",
            "self._terminal.write(data)",
            "self._n = getattr(self, '_n', 0) + 1\n    if self._n != 9: self._terminal.write(data)",
        ),
    ),
    "its channels vibrate at half the frequency": _bug(
        "plays",
        Edit(
            "sim.amplifier.channels:Channels.play",
            "frequency=command.frequency",
            "frequency=command.frequency / 2",
        ),
    ),
    "it plays a tenth of the level": _bug(
        "plays",
        Edit(
            "sim.amplifier.channels:Channels.play",
            "amplitude=_amplitude(command),",
            "amplitude=_amplitude(command) / 10,",
        ),
    ),
    "it says that nothing plays": _bug(
        "plays",
        Edit(f"{_FAR}.status", "levels=levels", "levels=(0.0,) * len(levels)"),
    ),
    "a torn set is played": _bug(
        "commit",
        Edit(
            "sim.far_ends.can_bus.sets:SetBuffer.command_set", "len(own) != request.count", "False"
        ),
        scenario=scenarios.torn,
        wire="slcan",
    ),
    "it takes sets while it is disarmed": _bug(
        "enabled",
        Edit("sim.amplifier.amplifier:next_state", "", "lambda state, request: state"),
        scenario=scenarios.strangers_set,
    ),
    "it says that it is only switched on": _bug(
        "state",
        Edit(
            f"{_FAR}.status",
            "state=self.state,",
            "state=State.SWITCHED_ON if self.state is State.OPERATION_ENABLED else self.state,",
        ),
    ),
    "an answer comes without its levels": _bug(
        "answer",
        Edit(
            "sim.far_ends.can_bus.requests:RequestHandler._answer",
            "reversed(sent.items())",
            "reversed(list(sent.items())[:2])",
        ),
        wire="socketcand",
    ),
    "it forgets which set plays": _bug(
        "token",
        Edit(f"{_FAR}.status", "self._sets.token", "0"),
    ),
}

BUGS = {**CONTROLLER, **DRIVERS, **FAR_ENDS}
