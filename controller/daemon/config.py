"""Reading a daemon's configuration, and everything that it names, before anything is touched."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from controller.api.socket_path import default_socket
from controller.daemon.sections import CalibrationSection, DaemonSection, TouchSection
from controller.effects.layout import Layout, usual_effects
from controller.effects.layout_file import is_layout_document, load_layout
from controller.sources.calibration import CalibratedSource, TouchCalibration, fitted, turned
from controller.sources.registry import open_source
from controller.sources.touch import TouchSource
from drivers.errors import CommandError
from drivers.registry import open_backend
from model.config.document import ConfigError, Document, read_document
from model.config.sections import Validation
from model.errors import InputError
from model.finger.perception import STRONG_DB_SL
from model.rig.file import load_rig
from model.rig.rig import Rig

API_SOURCES = "api"
"""What the sources of clients of the API are called, before the colon; nothing else is."""


@dataclass(frozen=True)
class TouchInput:
    """A touch source by its name in the configuration, not yet made."""

    name: str
    url: str
    calibration: TouchCalibration

    def make(self) -> TouchSource:
        """The source in the plate's coordinates; raises InputError."""
        return CalibratedSource(open_source(self.url), self.calibration)


@dataclass(frozen=True)
class DaemonConfig:
    """All that a daemon runs by; rig_text: the rig's file as it stands there.

    urls: by amplifier; table: its file, or None to build it or take it from the cache; layout: None
    for one effect everywhere.
    """

    source: Path
    section: DaemonSection
    rig: Rig
    rig_file: Path
    rig_text: str
    urls: Mapping[str, str]
    table: Path | None
    layout: Layout | None
    touch: tuple[TouchInput, ...]
    socket: Path
    log_file: Path | None
    dump_folder: Path | None

    @property
    def meaning(self) -> Layout:
        """What touches mean: the layout, or without one that every touch buzzes where it is."""
        return self.layout or Layout(effects=usual_effects(self.section.level_db_sl))


def load_daemon_config(path: Path) -> DaemonConfig:
    """Read a daemon's file and the rig that it names; raises ConfigError with every problem."""
    document = read_document(path)
    _check_kind(document)
    validation = Validation(document, DaemonSection)
    rig_file = _file(document, "rig")
    rig, rig_text = _rig(validation, rig_file)
    urls = _urls(validation, rig, rig_file)
    touch = _touch(validation, document, rig)
    table = _file(document, "table")
    if table is not None and not table.is_file():
        validation.add(("table",), f"there is no file {table}; check its name and folder")
    layout = _layout(validation, document, rig)
    _check_serial_numbers(validation, rig)
    log_file = _beside(document, _named(document, "log", "file"))
    dump_folder = _beside(document, _named(document, "dumps", "folder"))
    _check_places(validation, log_file, dump_folder)
    validation.finish()
    assert rig is not None  # noqa: S101  else there was a problem
    assert rig_file is not None  # noqa: S101  or there is no rig
    section = DaemonSection.model_validate(document.data)
    return DaemonConfig(
        source=path,
        section=section,
        rig=rig,
        rig_file=rig_file,
        rig_text=rig_text,
        urls=urls,
        table=table,
        layout=layout,
        touch=touch,
        socket=_file(document, "socket") or default_socket(),
        log_file=log_file,
        dump_folder=dump_folder,
    )


def is_daemon_document(document: Document) -> bool:
    """Whether a configuration file is a daemon's: it names a rig and is none."""
    return "rig" in document.data and "plate" not in document.data


def _check_kind(document: Document) -> None:
    """Refuse another kind of file as a whole, in place of all the keys that it does not know."""
    if "rig" in document.data:
        return
    is_layout = is_layout_document(document)
    if is_layout or "plate" in document.data:
        raise InputError(
            f"{document.source}: is a {'surface layout' if is_layout else 'rig'}, which a daemon's "
            f"file names with {'layout' if is_layout else 'rig'}: FILE; write one with  era config "
            "init daemon.yaml --kind daemon"
        )


def _file(document: Document, key: str) -> Path | None:
    """A file that a key names, from the folder of the configuration; None for none."""
    return _beside(document, _named(document, key))


def _named(document: Document, *keys: str) -> str | None:
    """What keys name, section by section; None where it is no file's name."""
    value: object = document.data
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value if isinstance(value, str) and "\0" not in value else None


def _beside(document: Document, name: str | None) -> Path | None:
    return None if name is None else Path(document.source).parent / Path(name).expanduser()


def _rig(validation: Validation, file: Path | None) -> tuple[Rig | None, str]:
    """The rig and its text; what is wrong with it stands at the key that names it."""
    if file is None:
        return None, ""
    try:
        return load_rig(file), file.read_text("utf-8")
    except ConfigError as error:
        validation.add(("rig",), "the rig cannot be used:\n    " + str(error).replace("\n", "\n  "))
    except (InputError, OSError) as error:
        validation.add(("rig",), f"the rig cannot be used: {error}")
    return None, ""


def _layout(validation: Validation, document: Document, rig: Rig | None) -> Layout | None:
    """The surface layout; what is wrong with it stands at the key that names it."""
    file = _file(document, "layout")
    if file is None:
        return None
    level = validation.field(("level_db_sl",), DaemonSection)
    try:
        return load_layout(
            file,
            None if rig is None else rig.plate,
            level_db_sl=STRONG_DB_SL if level is None else level,
        )
    except InputError as error:
        told = str(error).replace("\n", "\n  ")
        validation.add(("layout",), f"the layout cannot be used:\n    {told}")
    return None


def _urls(validation: Validation, rig: Rig | None, rig_file: Path | None) -> dict[str, str]:
    """How to reach each amplifier; `sim://` is one over the rig itself."""
    if rig is None or rig_file is None:
        return {}
    here = quote(str(rig_file.resolve()))
    urls = {
        name: f"sim://{here}?amplifier={quote(name)}" if url == "sim://" else url
        for name, url in rig.amplifiers.items()
    }
    for name, url in urls.items():
        try:
            open_backend(url)
        except CommandError as error:
            validation.add(("rig",), f"amplifiers.{name}.url of the rig cannot be used: {error}")
    if len(urls) > 1 and any(url.startswith("sim://") for url in urls.values()):
        validation.add(
            ("rig",),
            "the rig has several amplifiers, which are simulated over one plate by a process of "
            "their own only: run era sim RIG --serial and put the URLs that it prints into the rig",
        )
    return urls


def _touch(validation: Validation, document: Document, rig: Rig | None) -> tuple[TouchInput, ...]:
    """The touch sources that are in order; a source is made once, to know that it can be."""
    listed = document.data.get("touch")
    inputs: list[TouchInput] = []
    for number, entry in enumerate(listed if isinstance(listed, list) else []):
        try:
            section = TouchSection.model_validate(entry)
        except ValueError:
            continue  # the validation has said so
        here = ("touch", number)
        if any(section.name == other.name for other in inputs):
            validation.add((*here, "name"), f"two sources are called {section.name}; rename one")
            continue
        if section.name == API_SOURCES:
            validation.add((*here, "name"), f"{API_SOURCES} is what programs are called; rename it")
        try:
            calibration = _calibration(section.calibration, rig)
            made = TouchInput(section.name, section.url, calibration)
        except InputError as error:
            validation.add((*here, "calibration"), str(error))
            continue
        try:
            made.make()
        except InputError as error:
            validation.add((*here, "url"), str(error))
        inputs.append(made)
    return tuple(inputs)


def _calibration(section: CalibrationSection, rig: Rig | None) -> TouchCalibration:
    is_turned = bool(section.turned or section.mirror)
    if is_turned + (section.matrix is not None) + (section.points is not None) > 1:
        raise InputError("give turned and mirror, or a matrix, or points, and no two of them")
    if section.matrix is not None:
        return TouchCalibration(section.matrix)
    if section.points is None or rig is None:  # without its plate a rig is refused anyway
        return turned(section.turned, mirror=section.mirror)
    plate = rig.plate
    return fitted(
        [
            (x / plate.length, 1 - y / plate.width)
            for x, y in (each.shown for each in section.points)
        ],
        [each.at for each in section.points],
        plate,
    )


def _check_places(validation: Validation, log: Path | None, dumps: Path | None) -> None:
    """What is written only later must have a place; who may write there is seen at the start.

    The log's folder must be there, that of the dumps is made when it is needed.
    """
    if log is not None and log.is_dir():
        validation.add(("log", "file"), f"{log} is a folder; name a file in it")
    elif log is not None and not log.parent.is_dir():
        validation.add(("log", "file"), f"there is no folder {log.parent}; make it")
    if dumps is not None:
        there = next(each for each in (dumps, *dumps.absolute().parents) if each.exists())
        if not there.is_dir():
            validation.add(("dumps", "folder"), f"{there} is no folder; name another")


def _check_serial_numbers(validation: Validation, rig: Rig | None) -> None:
    for name in validation.mapping(("serial_numbers",)):
        if rig is not None and name not in rig.amplifiers:
            validation.add(
                ("serial_numbers", name),
                f"the rig has no such amplifier; it has {', '.join(rig.amplifiers)}",
            )
