"""Promises of a table played and measured through a sound card."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress

import numpy as np

from drivers.by_hand.blocking import BlockingAmplifier
from drivers.contents import Tone
from drivers.errors import DriverError, LinkError
from model.arrays import FloatArray
from model.errors import InputError
from model.rig.rig import Rig
from model.table.pattern import Pattern
from model.table.promise_at_sensors import (
    MeasuredVerification,
    Promise,
    measured_promise,
    promises,
)
from model.table.table import LocalizationTable
from model.table.table_check import CheckSettings
from model.vibration.excitation import Excitation
from sim.measuring.checks import check_levels
from sim.measuring.desk import Desk
from sim.measuring.loopback import is_whole
from sim.measuring.sound_card import SoundCard, open_card
from sim.sensors.sensor_file import WiredSensor, read_sensors

_SETTLING = 1.5  # s; T60 of a plate with little damping, and an amplifier that starts later
_WINDOW = 1.0  # s
_RAMP = 0.04  # s
_PLAYED = _SETTLING + _WINDOW + _RAMP  # s
_TRIES = 3
_MARK = 1000.0  # Hz; of the loop-back, by which lost blocks show
_MARK_LEVEL = 0.3

Recorder = Callable[[Promise], FloatArray]
"""Plays a promise, and returns samples (n, inputs) of the plate that has settled."""


def check_table(
    table: LocalizationTable,
    rig: Rig,
    settings: CheckSettings,
    *,
    progress: Callable[[int, int], None],
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
    places = {sensor.name: (sensor.x, sensor.y) for sensor in sensors}
    found = []
    with _recorder(desk, settings, level) as (card, record):
        for promise in promises(
            table, places, count=settings.samples, level=level, seed=settings.seed
        ):
            _check_frequencies(promise.pattern.excitation, rig)
            heard = record(promise)
            check_levels(heard, _sensors_of(promise, desk))
            frequencies, amplitudes = _amplitudes(heard, promise, desk, card.rate)
            found.append(measured_promise(table, promise, frequencies, amplitudes))
            progress(len(found), settings.samples)
    return MeasuredVerification(tuple(found))


@contextmanager
def _recorder(
    desk: Desk, settings: CheckSettings, level: float
) -> Iterator[tuple[SoundCard, Recorder]]:
    """An open card, and an amplifier where that plays; level: no sample is larger."""
    with ExitStack() as stack:
        if settings.url is None:
            card = open_card(settings.device, outputs=desk.output, inputs=desk.input, limit=level)
            stack.callback(card.close)
            yield card, lambda promise: _by_card(card, desk, promise.pattern, level)
            return
        card = open_card(settings.device, outputs=0, inputs=desk.input, limit=0)
        stack.callback(card.close)
        (name,) = {channel.amplifier for channel in desk.rig.wiring.values()}
        amplifier = stack.enter_context(
            BlockingAmplifier(
                settings.url, limits=desk.rig.limits, is_output=name in desk.rig.outputs
            )
        )
        amplifier.arm()
        thread = stack.enter_context(ThreadPoolExecutor(max_workers=1))

        def by_amplifier(promise: Promise) -> FloatArray:
            seconds = _SETTLING + _WINDOW
            tones = tones_of(desk.rig, promise.pattern.excitation)
            count = round(seconds * card.rate)
            try:
                playing = thread.submit(
                    amplifier.play, tones, duration=seconds + _SETTLING, ramp=_RAMP
                )
                heard = card.run(np.zeros((count, 0)))
                playing.result()
            except BaseException:  # leaving waits for the thread, which feeds the watchdog
                with suppress(DriverError):
                    amplifier.disarm()
                raise
            if card.gaps:
                raise LinkError("blocks of sound were lost while a pattern played; verify again")
            return heard[-round(_WINDOW * card.rate) :].astype(float)

        yield card, by_amplifier


def _check_frequencies(excitation: Excitation, rig: Rig) -> None:
    """Raise InputError for tones outside of the rig's limits: a table may have been built of more.

    An amplifier's guard refuses them, too.
    """
    low, high = rig.limits.frequency_min, rig.limits.frequency_max
    for name, tone in excitation.items():
        if not low <= tone.frequency <= high:
            raise InputError(
                f"frequencies must be within the rig's limits.frequency of {low:g} to {high:g} Hz, "
                f"got {tone.frequency:g} Hz of ERA {name} in the table; build it again"
            )


def _by_card(card: SoundCard, desk: Desk, pattern: Pattern, level: float) -> FloatArray:
    """Play a pattern from memory: a level is a sample, as of an amplifier of voltage.

    level: that no output exceeds, the loop-back's included, since cables may be swapped.
    """
    excitation = pattern.excitation
    times = np.arange(round(_PLAYED * card.rate)) / card.rate
    sources = np.zeros((len(times), len(desk.eras) + 1))
    for number, era in enumerate(desk.rig.eras):
        if (tone := excitation.get(era.name)) is not None:
            angle = 2 * np.pi * tone.frequency * times + tone.phase
            sources[:, number] = tone.amplitude / era.stroke * np.sin(angle)
    sources[:, -1] = min(_MARK_LEVEL, level) * np.sin(2 * np.pi * _MARK * times)
    ramp = np.sin(np.linspace(0, np.pi / 2, round(_RAMP * card.rate))) ** 2
    sources[: len(ramp)] *= ramp[:, None]
    sources[-len(ramp) :] *= ramp[::-1, None]
    played = desk.on_outputs(sources)
    start, count = (round(each * card.rate) for each in (_SETTLING, _WINDOW))
    for _ in range(_TRIES):
        heard = card.run(played)[start : start + count].astype(float)
        if is_whole(heard[:, desk.input - 1], samples=count // 4):
            return heard
    raise LinkError(
        f"blocks of sound were lost in {_TRIES} attempts, or no cable leads from output "
        f"{desk.output} to input {desk.input}; check it, and end other programs"
    )


def tones_of(rig: Rig, excitation: Excitation) -> list[Tone]:
    """Tones of the channels of a rig's one amplifier."""
    return [
        Tone(
            rig.wiring[name].number,
            tone.frequency,
            tone.amplitude / rig.era(name).stroke,
            float(np.degrees(tone.phase)),
        )
        for name, tone in excitation.items()
    ]


def _sensors_of(promise: Promise, desk: Desk) -> list[WiredSensor]:
    by_name = {sensor.name: sensor for sensor in desk.sensors}
    return [by_name[name] for name in promise.sensors]


def _amplitudes(
    heard: FloatArray, promise: Promise, desk: Desk, rate: float
) -> tuple[FloatArray, FloatArray]:
    """Frequencies (f,) [Hz] and amplitudes (f, sensors) [m/s²] at the sensors of a promise.

    All tones are fitted together, since their frequencies need not fit into the window.
    """
    frequencies = np.unique([tone.frequency for tone in promise.pattern.excitation.values()])
    sensors = _sensors_of(promise, desk)
    samples = heard[:, [sensor.input - 1 for sensor in sensors]]
    angles = 2 * np.pi * np.outer(np.arange(len(samples)) / rate, frequencies)
    basis = np.hstack([np.sin(angles), np.cos(angles)])
    fitted, *_ = np.linalg.lstsq(basis, samples)
    sizes = np.hypot(*np.split(fitted, 2))
    return frequencies, sizes / np.abs([sensor.sensitivity for sensor in sensors])
