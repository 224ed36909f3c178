"""Commands of a fleet: what is computed of the trips of a catalogue.

Other modules add their commands to `fleet_app`, as those of the map do to theirs.
"""

from __future__ import annotations

import typer

app = typer.Typer()
fleet_app = typer.Typer(
    no_args_is_help=True, help="A fleet: what is computed of the trips of a catalogue."
)
app.add_typer(fleet_app, name="fleet", rich_help_panel="Fleet")
