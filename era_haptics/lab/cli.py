"""The lab's share of the `era` command: to measure, judge, design, check and report."""

import typer

from drivers.by_hand.cli import EXIT_STATUS as EXIT_STATUS
from era_haptics.lab.checks.content_cli import content_app, play
from era_haptics.lab.checks.layout_cli import layout_app
from era_haptics.lab.conformance.conformance_cli import conformance
from era_haptics.lab.design.design_cli import design_app
from era_haptics.lab.measuring.measure_cli import MeasureCommand, measure, outputs
from era_haptics.lab.paper_figures_cli import figure_app
from era_haptics.lab.report_cli import report
from era_haptics.lab.witness.witness_cli import witness

amp = typer.Typer()
amp.command()(conformance)

app = typer.Typer()
app.add_typer(amp, name="amp")
app.add_typer(content_app, name="content")
app.add_typer(layout_app, name="layout")
app.add_typer(design_app)
app.add_typer(figure_app)
for _command in (play, report, witness, outputs):
    app.command()(_command)
app.command(cls=MeasureCommand)(measure)
