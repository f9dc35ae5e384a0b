"""What the control socket of a far end takes: version 2 of its lines.

    {"op": "hello"}                            {"protocol": "era-sim-control", "version": 2,
                                                "clock": "wall" or "virtual", "ops": [...],
                                                "urls": {NAME: URL}}
    {"op": "state"}                            {"time_s": t, "fingers": {ID: [x, y]},
                                                "amplifiers": {NAME: {"state", "fault", "token",
                                                "high_voltage", "levels"}}}

    fingers, their places [x, y] in metres
    {"op": "fingers", "fingers": {ID: [x, y]}} these rest there, no others: {"ok": true, "time_s"}
    {"op": "come", "finger": ID, "at_m": [x, y]}       one more; "move": one that is there;
    {"op": "go", "finger": ID}                         lifted
    {"op": "felt", "since_s": t0, "until_s": t1}
        {"fingers": {ID: {"points_m": [[x, y], ...], "frequencies_hz": [f, ...],
                          "amplitude_m_s2": [[one per point], one row per frequency],
                          "peak_m_s2": [one per point]}}}

    sensors
    {"op": "sensors", "sensors": {NAME: {"at_m": [x, y], "noise_m_s2_rthz", "reach_m_s2",
                                         "resolution_m_s2", "scale"}}}
                                                       all but at_m may be left out; no others stay
    {"op": "signals", "since_s": t0, "until_s": t1}    {"sample_rate_hz", "start_s",
                                                        "sensors": {NAME: {"at_m", "m_s2": [...]}}}
    {"op": "tones", "since_s", "until_s", "frequencies_hz": [f, ...]}
        {"sensors": {NAME: {"at_m", "real_m_s2": [one per frequency], "imag_m_s2": [...]}}}
        by least squares over the signals; Im[a exp(i omega t)], t the far end's time

    {"op": "befall", "fault": ..., "lasts": ..., ...}  a fault as in a fault file, from now on
    {"op": "faults"}                                   {"faults": {NAME: [{"fault", "begin_s",
                                                           "end_s" or null, "is_on"}]}}
    {"op": "recover", "amplifier": NAME}               every fault ends; without a name, of all
    {"op": "step", "seconds": s}                       lets virtual time pass: {"time_s": t}
    {"op": "record", "file": PATH}                     sensors and fingers that are there now
    {"op": "finish"}                                   writes it: {"file", "seconds", "is_full"}

Times are the far end's [s]: time.monotonic(), or the virtual clock, which begins at 0. Of felt,
signals and tones the last ten seconds can be had. What is wrong gets {"error": TEXT} and changes
nothing.
"""

import json
import math
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from model.errors import InputError
from sim.control.site import Site
from sim.control.values import finger_of, is_number, number_of, place_of, window_of
from sim.faults.file import episode_of
from sim.plant.felt import feel
from sim.plant.finger import Position, Record
from sim.sensors.accelerometer import Accelerometer
from sim.sensors.recorder import Recorder
from sim.sensors.recording import Recording
from sim.sensors.signal_measures import tone_phasors

VERSION = 2
_STEP_MAX = 3600.0  # s of virtual time in one request
_TONES_MAX = 64

_Answer: TypeAlias = Callable[[], dict[str, Any]]
"""Makes an answer, or raises InputError; touches nothing of the bench: any thread may do it."""


@dataclass(frozen=True)
class Wait:
    """Something has to pass first, in the event loop, and then the answer can be made."""

    passes: Callable[[], Coroutine[Any, Any, None]]
    then: Callable[[], dict[str, Any]]


def carry_out(site: Site, line: bytes, *, now: float) -> Callable[[], dict[str, Any]] | Wait:
    """Do what one line of control asks now [s]; returns what makes the answer to it.

    Making it may take long and touches nothing of the bench any more: any thread may do it.
    """
    try:
        request = json.loads(line)
        if not isinstance(request, dict):
            raise InputError("a line must be a JSON object")
        op = request.get("op")
        if not isinstance(op, str) or op not in _OPS:
            raise InputError(f"op is {str(op)[:40]!r}; it must be one of {', '.join(_OPS)}")
        made = _OPS[op](site, request, now)
    except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
        return _already({"error": f"not a line of JSON: {error}"})
    except (InputError, OSError) as error:
        return _already({"error": str(error)})
    return made if isinstance(made, Wait) else lambda: _made(made)


def _made(answer: _Answer) -> dict[str, Any]:
    try:
        return answer()
    except (InputError, OSError) as error:
        return {"error": str(error)}


def _hello(site: Site, request: dict[str, Any], now: float) -> _Answer:
    return _already(
        {
            "protocol": "era-sim-control",
            "version": VERSION,
            "clock": "wall" if site.step is None else "virtual",
            "ops": list(_OPS),
            "urls": dict(site.urls),
        }
    )


def _state(site: Site, request: dict[str, Any], now: float) -> _Answer:
    bench = site.bench
    bench.advance(now)
    amplifiers = {}
    for name, amplifier in bench.amplifiers.items():
        status = amplifier.status(bench.time)
        amplifiers[name] = {
            "state": status.state.name,
            "fault": status.fault.name,
            "token": status.token,
            "high_voltage": status.high_voltage,
            "levels": list(status.levels),
        }
    fingers = {name: list(place) for name, place in bench.fingers.layout.positions.items()}
    return _already({"time_s": bench.time, "fingers": fingers, "amplifiers": amplifiers})


def _fingers(site: Site, request: dict[str, Any], now: float) -> _Answer:
    fingers = request.get("fingers")
    if not isinstance(fingers, dict):
        raise InputError('fingers must be an object of positions, as in {"1": [0.10, 0.08]}')
    places = {
        name: place_of(place, what=f"finger {name[:40]!r}") for name, place in fingers.items()
    }
    return _placed(site, places, now)


def _come(site: Site, request: dict[str, Any], now: float) -> _Answer:
    name, present = finger_of(request), site.bench.fingers.layout.positions
    if (name in present) != (request["op"] == "move"):
        there = "is on the plate already" if name in present else "is not on the plate"
        raise InputError(f"finger {name!r} {there}")
    at = place_of(request.get("at_m"), what=f"finger {name!r}")
    return _placed(site, {**present, name: at}, now)


def _go(site: Site, request: dict[str, Any], now: float) -> _Answer:
    name, present = finger_of(request), site.bench.fingers.layout.positions
    if name not in present:
        raise InputError(f"finger {name!r} is not on the plate")
    return _placed(site, {id: at for id, at in present.items() if id != name}, now)


def _placed(site: Site, places: Mapping[str, Position], now: float) -> _Answer:
    site.bench.place_fingers(places, now=now)
    return _already({"ok": True, "time_s": site.bench.time})


def _felt(site: Site, request: dict[str, Any], now: float) -> _Answer:
    since, until = window_of(request)
    site.bench.advance(now)
    records, frequencies = site.bench.records(since, until)
    return lambda: {"fingers": {id: _as_felt(rec, frequencies) for id, rec in records.items()}}


def _as_felt(record: Record, frequencies: Sequence[float]) -> dict[str, Any]:
    felt = feel(record, frequencies)
    return {
        "points_m": felt.points.tolist(),
        "frequencies_hz": list(felt.frequencies),
        "amplitude_m_s2": felt.amplitude.tolist(),
        "peak_m_s2": felt.peak.tolist(),
    }


def _sensors(site: Site, request: dict[str, Any], now: float) -> _Answer:
    asked = request.get("sensors")
    if not isinstance(asked, dict):
        raise InputError('sensors must be an object, as in {"P1": {"at_m": [0.10, 0.08]}}')
    sensors = [_sensor(name, told) for name, told in asked.items()]
    site.bench.advance(now)
    site.accelerometers.place(sensors)
    return _already({"ok": True, "time_s": site.bench.time})


def _sensor(name: str, told: object) -> Accelerometer:
    if not isinstance(told, dict):
        raise InputError(f'sensor {name[:40]!r} needs {{"at_m": [x, y]}} at least')
    unknown = sorted(told.keys() - {"at_m", *_SENSOR_KEYS})
    if unknown:
        raise InputError(f"sensor {name[:40]!r}: {unknown[0][:40]!r} is unknown")
    x, y = place_of(told.get("at_m"), what=f"sensor {name[:40]!r}")
    values = {key: number_of(told, key, unit) for key, unit in _SENSOR_KEYS.items() if key in told}
    return Accelerometer(
        name,
        x,
        y,
        values.get("noise_m_s2_rthz", 0.0),
        values.get("reach_m_s2", math.inf),
        values.get("resolution_m_s2", 0.0),
        values.get("scale", 1.0),
    )


_SENSOR_KEYS = {
    "noise_m_s2_rthz": "m/s²/√Hz",
    "reach_m_s2": "m/s²",
    "resolution_m_s2": "m/s²",
    "scale": "readings per truth",
}


def _signals(site: Site, request: dict[str, Any], now: float) -> _Answer:
    recording = _recorded(site, request, now)
    return lambda: {
        "sample_rate_hz": recording.sample_rate,
        "start_s": recording.start,
        "sensors": {
            name: {"at_m": at, "m_s2": samples}
            for name, at, samples in zip(
                recording.names,
                recording.points.tolist(),
                recording.samples.T.tolist(),
                strict=True,
            )
        },
    }


def _tones(site: Site, request: dict[str, Any], now: float) -> _Answer:
    frequencies = request.get("frequencies_hz")
    if not (
        isinstance(frequencies, list)
        and 0 < len(frequencies) <= _TONES_MAX
        and all(is_number(f) and 0 < f < site.bench.sample_rate / 2 for f in frequencies)
        and len(set(frequencies)) == len(frequencies)
    ):
        raise InputError(
            f"frequencies_hz must be 1 to {_TONES_MAX} different frequencies below "
            f"{site.bench.sample_rate / 2:g} Hz"
        )
    recording = _recorded(site, request, now)

    def answer() -> dict[str, Any]:
        found = tone_phasors(recording, frequencies)
        return {
            "sensors": {
                name: {"at_m": at, "real_m_s2": column.real.tolist(), "imag_m_s2": imag}
                for name, at, column, imag in zip(
                    recording.names,
                    recording.points.tolist(),
                    found.T,
                    found.imag.T.tolist(),
                    strict=True,
                )
            }
        }

    return answer


def _recorded(site: Site, request: dict[str, Any], now: float) -> Recording:
    since, until = window_of(request)
    site.bench.advance(now)
    return site.accelerometers.read(since, until)


def _befall(site: Site, request: dict[str, Any], now: float) -> _Answer:
    told = {key: value for key, value in request.items() if key != "op"}
    episode = episode_of(told)
    for station in site.stations_of(episode.amplifier):
        station.befall(episode)
    return _already({"ok": True, "time_s": now})


def _faults(site: Site, request: dict[str, Any], now: float) -> _Answer:
    listed = {}
    for name, station in site.stations.items():
        begin = station.faults.begin
        listed[name] = [
            {
                "fault": episode.fault,
                "begin_s": begin + episode.at,
                "end_s": begin + episode.end if math.isfinite(episode.end) else None,
                "is_on": episode.at <= now - begin < episode.end,
            }
            for episode in station.faults.episodes
        ]
    return _already({"faults": listed})


def _recover(site: Site, request: dict[str, Any], now: float) -> _Answer:
    for station in site.stations_of(request.get("amplifier")):
        station.recover()
    return _already({"ok": True, "time_s": now})


def _step(site: Site, request: dict[str, Any], now: float) -> Wait:
    seconds, step = number_of(request, "seconds", "seconds"), site.step
    if step is None:
        raise InputError("time is the clock's here; start the far end with --virtual-time")
    if not 0 < seconds <= _STEP_MAX:
        raise InputError(f"seconds is {seconds:g}; it must lie between 0 and {_STEP_MAX:g}")

    async def passes() -> None:
        await step(seconds)
        site.bench.advance(now + seconds)

    return Wait(passes, lambda: {"ok": True, "time_s": site.bench.time})


def _record(site: Site, request: dict[str, Any], now: float) -> _Answer:
    file = request.get("file")
    if not isinstance(file, str) or not file:
        raise InputError("file must be the name of a recording, as in run.csv")
    site.bench.advance(now)
    site.record(Path(file))
    return _already({"ok": True, "time_s": site.bench.time})


def _finish(site: Site, request: dict[str, Any], now: float) -> _Answer:
    site.bench.advance(now)
    recorder = site.stop_recording()
    return lambda: _finished(recorder)


def _finished(recorder: Recorder) -> dict[str, Any]:
    recorder.finish()
    return {
        "file": str(recorder.path),
        "seconds": recorder.seconds,
        "is_full": recorder.is_full,
    }


_OPS: Mapping[str, Callable[[Site, dict[str, Any], float], _Answer | Wait]] = {
    "hello": _hello,
    "state": _state,
    "fingers": _fingers,
    "come": _come,
    "move": _come,
    "go": _go,
    "felt": _felt,
    "sensors": _sensors,
    "signals": _signals,
    "tones": _tones,
    "befall": _befall,
    "faults": _faults,
    "recover": _recover,
    "step": _step,
    "record": _record,
    "finish": _finish,
}


def _already(reply: dict[str, Any]) -> Callable[[], dict[str, Any]]:
    return lambda: reply
