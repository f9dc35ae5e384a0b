"""Promises of a table played and measured through a sound card."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from functools import partial

import numpy as np

from drivers.by_hand.actions import BlockingAmplifier
from drivers.errors import DriverError
from drivers.playing import AmplifierLayer, AmplifierTone
from era_haptics.lab.measuring.measure import check_levels, has_all_blocks
from era_haptics.lab.measuring.sound_card import (
    Desk,
    Run,
    SoundCard,
    open_card,
    play_and_record,
    ramped,
    read_sensors,
)
from model.answer.answer import Layer
from model.processes import Progress
from model.rig.rig import Rig
from model.study.promise_at_sensors import (
    CheckSettings,
    MeasuredVerification,
    measured_promise,
    promises,
)
from model.table.table import LocalizationTable
from sim.plant.fingers import fit_tones

_SETTLING = 1.5  # s; T60 of a plate with little damping, and an amplifier that starts later
_WINDOW = 1.0  # s
_RAMP = 0.04  # s
_PLAYED = _SETTLING + _WINDOW + _RAMP  # s
_MARK = 1000.0  # Hz; of the loop-back, by which lost blocks show
_MARK_LEVEL = 0.3


def check_table(
    table: LocalizationTable,
    rig: Rig,
    settings: CheckSettings,
    *,
    progress: Progress,
) -> MeasuredVerification:
    """Play promises and compare what accelerometers measured.

    Raises InputError, LinkError, both also for sensors that are clipped or silent; CommandError,
    CommandRefused of an amplifier.
    """
    sensors = read_sensors(settings.sensors_file, rig.plate)
    desk = Desk(rig, sensors)
    level = desk.highest / 2 if settings.level is None else settings.level
    desk.check(level)
    if settings.url is None:
        desk.check_times(seconds=_PLAYED, slew=np.pi / 2 * level / _RAMP)
    by_name = {sensor.name: sensor for sensor in sensors}
    named = desk.named_inputs
    places = {name: (sensor.x, sensor.y) for name, sensor in by_name.items()}
    found = []
    is_card = settings.url is None
    with ExitStack() as stack:
        card = stack.enter_context(
            closing(
                open_card(
                    settings.device,
                    outputs=desk.output if is_card else 0,
                    inputs=desk.input,
                    limit=level if is_card else 0,
                )
            )
        )
        if settings.url is None:
            record = partial(_by_card, card, desk, level)
        else:
            is_output = not rig.outputs.isdisjoint(rig.amplifiers)
            amplifier = stack.enter_context(
                BlockingAmplifier(settings.url, limits=rig.limits, is_output=is_output)
            )
            amplifier.arm()
            record = partial(_by_amplifier, card, amplifier, rig)
        for promise in promises(
            table, places, count=settings.samples, level=level, seed=settings.seed
        ):
            excitation = promise.layer.excitation
            frequencies = np.unique([tone.frequency for tone in excitation.values()])
            # A table may have been built of more; an amplifier's ledger refuses them, too.
            desk.check_frequencies(frequencies, what="frequencies of the table")
            run = record(promise.layer)
            chosen = [by_name[name] for name in promise.sensors]
            inputs = [sensor.input for sensor in chosen]
            cable = [desk.input] if is_card else []
            check_levels(run.recorded, {n: named[n] for n in [*inputs, *cable]})
            # All tones are fitted together, since their frequencies need not fit into the window.
            samples = run.whole[:, [n - 1 for n in inputs]]
            tones = fit_tones(np.arange(len(samples)) / card.rate, samples, frequencies.tolist())
            amplitudes = np.abs(tones / [sensor.sensitivity for sensor in chosen])
            found.append(measured_promise(table, promise, frequencies, amplitudes))
            progress(len(found), settings.samples)
    return MeasuredVerification(tuple(found))


def _by_amplifier(card: SoundCard, amplifier: BlockingAmplifier, rig: Rig, pattern: Layer) -> Run:
    """Record what an amplifier plays, once."""
    seconds = _SETTLING + _WINDOW
    tones = tuple(
        AmplifierTone(
            rig.wiring[name].number,
            tone.frequency,
            tone.amplitude / rig.era(name).full_level,
            float(np.degrees(tone.phase)),
        )
        for name, tone in pattern.excitation.items()
    )
    with ThreadPoolExecutor(max_workers=1) as thread:
        try:
            playing = thread.submit(
                amplifier.play,
                [AmplifierLayer(0, tones, _RAMP)],
                duration=seconds + _SETTLING,
            )
            run = play_and_record(
                card,
                np.zeros((round(seconds * card.rate), 0)),
                settling=_SETTLING,
                seconds=_WINDOW,
                is_whole=lambda _kept: not card.gaps,
                tries=1,
            )
            playing.result()
        except BaseException:  # leaving waits for the thread, which feeds the watchdog
            with suppress(DriverError):
                amplifier.disarm()
            raise
    return run


def _by_card(card: SoundCard, desk: Desk, level: float, pattern: Layer) -> Run:
    """Play a pattern from memory: a level is a sample, as of an amplifier whose output it is.

    level: that no output exceeds, the loop-back's included, since cables may be swapped.
    """
    excitation = pattern.excitation
    times = np.arange(round(_PLAYED * card.rate)) / card.rate
    sources = np.zeros((len(times), len(desk.eras) + 1))
    for number, era in enumerate(desk.rig.eras):
        if (tone := excitation.get(era.name)) is not None:
            angle = 2 * np.pi * tone.frequency * times + tone.phase
            sources[:, number] = tone.amplitude / era.full_level * np.sin(angle)
    sources[:, -1] = min(_MARK_LEVEL, level) * np.sin(2 * np.pi * _MARK * times)
    quarter = round(_WINDOW * card.rate) // 4
    return play_and_record(
        card,
        desk.on_outputs(ramped(sources, round(_RAMP * card.rate))),
        settling=_SETTLING,
        seconds=_WINDOW,
        is_whole=lambda kept: has_all_blocks(kept[:, desk.input - 1], samples=quarter),
    )
