"""Operations of control on faults: what befalls amplifiers and their wires, and when it is over."""

import math
from collections.abc import Mapping
from typing import Any

from sim.control.answers import Answer, Operation, already
from sim.control.site import Site
from sim.faults.file import episode_of


def _befall(site: Site, request: dict[str, Any], now: float) -> Answer:
    told = {key: value for key, value in request.items() if key != "op"}
    episode = episode_of(told)
    for station in site.stations_of(episode.amplifier):
        station.befall(episode)
    return already({"ok": True, "time_s": now})


def _faults(site: Site, request: dict[str, Any], now: float) -> Answer:
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
    return already({"faults": listed})


def _recover(site: Site, request: dict[str, Any], now: float) -> Answer:
    for station in site.stations_of(request.get("amplifier")):
        station.recover()
    return already({"ok": True, "time_s": now})


OPERATIONS: Mapping[str, Operation] = {
    "befall": _befall,
    "faults": _faults,
    "recover": _recover,
}
