"""The daemon's reply to a client's hello: rig, table, drive mode, layout."""

from collections.abc import Mapping
from importlib.metadata import version

from controller.api.methods import HelloResult
from controller.api.schema import API_VERSION, EraPosition, RigSummary, TableSummary
from controller.daemon.config import DaemonConfig
from drivers.host.amplifier import Amplifier
from model.rig.rig import Rig
from model.table.table import LocalizationTable


def hello_result(
    config: DaemonConfig,
    table: LocalizationTable,
    amplifiers: Mapping[str, Amplifier],
    *,
    drive_mode: str,
    layout: dict[str, object] | None,
) -> HelloResult:
    """Describe what the daemon drives."""
    return HelloResult(
        api_version=API_VERSION,
        software_version=version("era-haptics"),
        rig=_rig_summary(config.rig, amplifiers),
        table=TableSummary(
            fingerprint=table.fingerprint,
            mode=drive_mode,
            frequencies_hz=[float(each) for each in table.frequencies],
            cells_x=table.grid.nx,
            cells_y=table.grid.ny,
        ),
        rig_text=config.rig_text,
        layout=layout,
    )


def _rig_summary(rig: Rig, amplifiers: Mapping[str, Amplifier]) -> RigSummary:
    return RigSummary(
        length_m=rig.plate.length,
        width_m=rig.plate.width,
        eras=[
            EraPosition(
                name=era.name,
                x_m=era.x,
                y_m=era.y,
                amplifier=rig.wiring[era.name].amplifier,
                channel=rig.wiring[era.name].number,
            )
            for era in rig.eras
        ],
        simulated=any(
            "simulated" in each.identity.get("product", "") for each in amplifiers.values()
        ),
        frequency_hz=[rig.limits.frequency_min, rig.limits.frequency_max],
    )
