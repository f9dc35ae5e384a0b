"""Build rigs from rig-file keys, open amplifiers, convert drives to layers, and calibrate."""

from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any
from weakref import finalize

from controller.play.routing import route
from controller.rig_file_check import whole_url
from drivers.by_hand.actions import BlockingAmplifier
from drivers.playing import AmplifierLayer
from era_haptics.drive import Played, expect_rig, playable_layers
from model.errors import InputError, expect_path, shown
from model.estimate.calibrate import calibrate as fit
from model.estimate.calibration_result import Calibration
from model.processes import Progress, check_progress, unseen
from model.response_files import measurement_of, read_measured
from model.rig.actuator_keys import EraSection, ExciterSection
from model.rig.plate_sections import PlateSection
from model.rig.rig import Rig
from model.rig.rig_writing import checked_keys, save_rig


class PlateKeys(dict[str, Any]):
    """Plate defined by the keys of `plate` in a rig file.

    `Plate(length="12 in", width="9 in", thickness=0.0015, material="aluminium")`. Raises
    ConfigError, an InputError, with all problems.
    """

    def __init__(self, **keys: Any) -> None:
        super().__init__(checked_keys("era.Plate", PlateSection, keys))


class EraKeys(dict[str, Any]):
    """ERA defined by the keys below `eras` in a rig file.

    `Era(at=(0, 0), stiffness="17 kN/m", amplifier="main", channel=0)`. Raises ConfigError.
    """

    def __init__(self, **keys: Any) -> None:
        super().__init__(checked_keys("era.Era", EraSection, keys))


class ExciterKeys(dict[str, Any]):
    """Exciter defined by the keys below `eras` in a rig file; `kind` is already set.

    `Exciter(type="DAEX25CT-4", at=(0.1, 0.1), amplifier="card", channel=0)`. Raises ConfigError.
    """

    def __init__(self, **keys: Any) -> None:
        keys = {"kind": "exciter", **keys}
        super().__init__(checked_keys("era.Exciter", ExciterSection, keys))


def open_amplifier(
    rig: Rig, name: str | None = None, *, url: str | None = None
) -> BlockingAmplifier:
    """Return an amplifier of the rig, open within a `with` block and disarmed after it.

    name: optional if the rig has only one; url: replaces the rig's; `sim://` simulates the
    amplifier on a plate of its own. Commands beyond the rig's limits are rejected. Raises
    InputError for an unknown name. Entering the block raises CommandError for an invalid URL,
    LinkError if there is no reply, and CommandRefused if the amplifier rejects a request.

    Example:
        >>> url = "sim://examples/paper_plate.yaml"
        >>> with era.open_amplifier(rig, url=url) as amplifier:
        ...     print(amplifier.capabilities["channels"], "channels")
        4 channels
    """
    expect_rig(rig)
    names = tuple(rig.amplifiers)
    if name is None and len(names) == 1:
        amplifier = names[0]
    elif name in names:
        amplifier = name
    else:
        raise InputError(f"name must be an amplifier of the rig, {', '.join(names)}, got {name!r}")
    if url is not None and not isinstance(url, str):
        raise InputError(f"url must be text such as 'sim://', got {shown(url)}")
    url = url or rig.amplifiers[amplifier]
    if url == "sim://":
        return _simulated_amplifier(rig, amplifier)
    return BlockingAmplifier(url, limits=rig.limits)


def _simulated_amplifier(rig: Rig, name: str) -> BlockingAmplifier:
    """Return an amplifier that is simulated from a copy of the rig, removed with it."""
    folder = mkdtemp(prefix="era-haptics-rig-")
    rig_file = Path(folder) / "rig.yaml"
    amplifier = BlockingAmplifier(whole_url("sim://", rig_file, name), limits=rig.limits)
    finalize(amplifier, rmtree, folder, ignore_errors=True)
    save_rig(rig, rig_file)
    return amplifier


def commands_for(rig: Rig, drive: Played) -> dict[str, tuple[AmplifierLayer, ...]]:
    """Convert a drive to amplifier layers by amplifier name, for `play` and `apply`.

    Each layer of an answer and each of its side bands becomes one amplifier layer, with its ramp,
    onset and ending. Channels follow the rig's wiring. Raises InputError for a drive that the rig
    cannot play.

    Example:
        >>> layers = era.commands_for(rig, only)["main"]
        >>> [(tone.channel, round(tone.level, 3)) for tone in layers[0].tones]
        [(0, 0.027), (1, 0.038), (2, 0.005), (3, 0.008)]
    """
    expect_rig(rig)
    voices = [voice for layer in playable_layers(drive, rig) for voice in layer.voices]
    commands: dict[str, list[AmplifierLayer]] = {name: [] for name in rig.amplifiers}
    for number, voice in enumerate(voices):
        routed = route(
            voice.excitation,
            rig,
            ramp=voice.ramp,
            number=number,
            onset=voice.onset,
            ending=voice.ending,
        )
        for name in rig.amplifiers:
            commands[name].append(routed[name])
    return {name: tuple(layers) for name, layers in commands.items()}


def calibrate(
    rig: Rig, measured: Path | str, *, all_scales: bool = False, progress: Progress = unseen
) -> Calibration:
    """Fit a rig to responses measured in a .csv, .uff or .unv file, like `era calibrate`.

    all_scales: estimate the scale of every sensor, not only of sensors with a wrong scale;
    progress: called with the number of fits done and the total. The result has the fitted `rig`
    with its uncertainty, and `parameters` with standard errors; use it only if `is_good`. Raises
    InputError, with the cause, for responses that contradict their metadata.

    Example:
        >>> fit = era.calibrate(rig, "examples/measured.csv")
        >>> fit.is_good
        True
    """
    expect_rig(rig)
    check_progress(progress)
    responses = measurement_of(read_measured(expect_path(measured, what="measured")), rig)
    return fit(rig, responses, all_scales=all_scales, progress=progress)
