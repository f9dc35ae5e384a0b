"""Commands of the lab."""

import typer

from drivers.by_hand.cli import EXIT_STATUS as EXIT_STATUS
from era_haptics.lab.checks.content_cli import content_app, play
from era_haptics.lab.checks.layout_cli import layout_app
from era_haptics.lab.conformance.conformance_cli import conformance
from era_haptics.lab.design.design_cli import design_app
from era_haptics.lab.measuring.measure_cli import measure, outputs
from era_haptics.lab.measuring.rig_cli import rig_app
from era_haptics.lab.rig_page.page_cli import page

amp = typer.Typer()
amp.command()(conformance)

plate = typer.Typer()
plate.command()(page)

app = typer.Typer()
app.add_typer(amp, name="amp")
app.add_typer(content_app, name="content")
app.add_typer(layout_app, name="layout")
app.add_typer(plate, name="plate")
app.add_typer(rig_app, name="rig")
app.add_typer(design_app)
for _command in (play, measure, outputs):
    app.command()(_command)
