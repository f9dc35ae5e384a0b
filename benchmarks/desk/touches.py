"""Touches felt on the desk: daemon and software amplifier play, accelerometers record."""

import contextlib
import csv
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.desk.session import ERA, Desk, Place, running
from controller.api.client import Client
from controller.api.jsonrpc import RpcError
from controller.api.link import Unreachable
from controller.api.methods import StatusResult
from era_haptics.lab.measuring.sound_card import open_card
from model.arrays import FloatArray
from model.finger import detection_threshold

_START = 180.0  # s; on a busy machine
REPEAT = 0.05  # s; a contact that is not confirmed is lifted
_SETTLING, _WINDOW = 1.5, 1.0  # s


@dataclass(frozen=True)
class Touch:
    """A touch among quiet fingers: felt contrast [dB] that the daemon promised, and measured."""

    fingers: int
    promised_db: float
    predicted_db: float
    measured_db: float


def touches(desk: Desk, sets: list[list[str]]) -> list[Touch]:
    """Touch sets of sensors' places, the target first, with fingers that weigh on the plate."""
    with (desk.folder / "sensors.csv").open() as lines:
        rows = list(csv.DictReader(lines))
    places = {row["sensor"]: (float(row["x_m"]), float(row["y_m"])) for row in rows}
    inputs = {row["sensor"]: int(row["input"]) - 1 for row in rows}
    found = []
    with playing(desk, level_db_sl=30) as era, era.armed("desk", lease_s=60):
        card = open_card("jack:desk", outputs=0, inputs=max(inputs.values()) + 1, limit=0)
        for names in sets:
            target, *quiet = (places[name] for name in names)
            desk.touch_plate([target, *quiet])
            status = hold(era, [*quiet, target], _SETTLING)
            recorded = card.start(np.zeros((round(_WINDOW * card.rate), 0)))
            while card.position < len(recorded):
                era.touch([*quiet, target])
                time.sleep(0.02)
            heard = recorded.astype(float)
            era.touch([])
            assert status.promised_contrast_db is not None
            assert status.predicted_contrast_db is not None
            samples = heard[:, [inputs[name] for name in names]]
            target_size, *quiet_sizes = sizes(samples, status, card.rate)
            found.append(
                Touch(
                    len(names),
                    status.promised_contrast_db,
                    status.predicted_contrast_db,
                    float(20 * np.log10(target_size / max(quiet_sizes))),
                )
            )
        card.close()
    return found


@contextlib.contextmanager
def playing(desk: Desk, *, level_db_sl: float) -> Iterator[Client]:
    """Software amplifier and daemon, which play what is calibrated and in the table once armed."""
    socket = desk.folder / "era.sock"
    config = (
        f"rig: calibrated.yaml\ntable: table.npz\nsocket: era.sock\nlevel_db_sl: {level_db_sl}\n"
    )
    (desk.folder / "daemon.yaml").write_text(config, "utf-8")
    amplifier = [ERA, "soft-amp", "--device", "jack:desk", "--channels", 4]
    amplifier += ["--link", desk.folder / "amp", "--until-eof"]
    daemon = [ERA, "daemon", "daemon.yaml"]
    with contextlib.ExitStack() as stack:
        log = stack.enter_context((desk.folder / "touches.log").open("w"))
        started = running(stack, amplifier, desk.folder, desk.environment, log)
        assert started.stdout is not None
        started.stdout.readline()
        running(stack, daemon, desk.folder, desk.environment, log)
        era = stack.enter_context(connected(socket))
        until_ready(era)
        yield era


def connected(socket: Path) -> Client:
    """A client of the daemon, as soon as it serves."""
    end = time.monotonic() + _START
    while True:
        try:
            return Client.connect(socket)
        except (Unreachable, OSError):
            if time.monotonic() > end:
                raise
            time.sleep(0.1)


def until_ready(era: Client) -> None:
    """Acknowledge what is left of before, until it can be armed."""
    end = time.monotonic() + _START
    while era.status().state != "READY_TO_SWITCH_ON":
        if time.monotonic() > end:
            raise RuntimeError(f"the daemon is not ready: {era.status().state}")
        with contextlib.suppress(RpcError):
            era.clear()
        time.sleep(0.1)


def hold(era: Client, places: list[Place], seconds: float) -> StatusResult:
    """Hold fingers for some time, and until something plays; return what does."""
    begin = time.monotonic()
    while True:
        era.touch(places)
        held = time.monotonic() - begin
        if held > seconds and (status := era.status()).drive:
            return status
        if held > seconds + _START:
            raise RuntimeError(f"nothing plays for fingers at {places}: {status.silence_reason}")
        time.sleep(REPEAT)


def sizes(samples: FloatArray, status: StatusResult, rate: float) -> FloatArray:
    """What is felt in samples (n, points) [m/s²] of what plays, relative to the threshold."""
    frequencies = np.unique([tone.frequency_hz for tone in status.drive.values()])
    angles = 2 * np.pi * np.outer(np.arange(len(samples)) / rate, frequencies)
    basis = np.hstack([np.sin(angles), np.cos(angles)])
    fitted = np.linalg.lstsq(basis, samples)[0]
    felt = np.hypot(*np.split(fitted, 2)) / detection_threshold(frequencies)[:, None]
    return np.asarray(np.linalg.norm(felt, axis=0))
