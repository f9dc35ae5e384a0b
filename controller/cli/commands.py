"""The commands of this package, of its share of the `era` command."""

import typer

from controller.cli.daemon import DashboardCommand, arm, daemon, of_method, status, touch, watch
from controller.cli.demo import demo
from controller.cli.gateway import gateway
from controller.cli.layout import layout_app
from controller.cli.report import report
from controller.cli.rig import rig_app
from drivers.by_hand import cli as by_hand
from model.errors import InputError

EXIT_STATUS = {**by_hand.EXIT_STATUS, InputError: 2}

app = typer.Typer()
app.add_typer(layout_app, name="layout")
app.add_typer(rig_app, name="rig")
app.command(cls=DashboardCommand)(daemon)
for _command in (arm, demo, gateway, report, status, touch, watch):
    app.command()(_command)

_METHODS = {
    "disarm": "Ramp to silence, then switch the high voltage off.",
    "stop": "Quick-stop all amplifiers, latched until era clear. Not an emergency stop.",
    "clear": "Acknowledge a stop, or a fault whose cause has gone. Stays disarmed.",
    "forget": "Discard what was learned of the plate, and learn anew.",
}
"""Methods of the API that are commands: help is quick, and does not load what they are made of."""

for _method, _help in _METHODS.items():
    app.command(_method, help=_help)(of_method(_method))
