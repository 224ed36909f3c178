"""Arguments and options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Logs = Annotated[list[Path], typer.Argument(help="Logs (.mcap), or folders of logs.")]
LineOption = Annotated[
    Path | None, typer.Option("--line", help="Line file; default: St.Gallen-Wil.")
]
TrainOption = Annotated[
    Path | None, typer.Option("--train", help="Train file; default: Stadler FLIRT.")
]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")]
