"""What follows from a result's declaration: text, HTML, JSON with its schema, CSV, pictures."""

from __future__ import annotations

import io
from dataclasses import dataclass

import pandas as pd
from refusals import refused
from rich.console import Console

from trainlog.errors import InputError
from trainlog.presentation import (
    ADHESION,
    MASS,
    SPEED,
    Band,
    Column,
    Ends,
    Presented,
    WordTable,
    new_table,
)

RUN_COLUMNS = (
    Column("train"),
    Column("top speed", SPEED, of="top"),
    Column("mass", MASS, band=True, rank=1),
    Column("adhesion", ADHESION, rank=2),
)


@dataclass(frozen=True)
class Run:
    train: str
    top: float
    mass: Band | None
    adhesion: Ends | None


@dataclass(frozen=True, eq=False, repr=False)
class Runs(Presented):
    runs: tuple[Run, ...]

    @property
    def title(self) -> str:
        return f"{len(self.runs)} runs"

    def summary(self) -> dict[str, str]:
        return {run.train: SPEED.words(run.top) for run in self.runs}

    def tables(self) -> list[WordTable]:
        return [new_table("Runs", *RUN_COLUMNS, name="runs").add_rows(self.runs)]

    @property
    def notes(self) -> tuple[str, ...]:
        return ("± is the 95 % band.",)


def runs() -> Runs:
    adhesion = Ends(0.15, 0.1, 0.2)
    first = Run("train 0", 20.0, None, adhesion)
    return Runs((first, Run("train 1", 21.0, Band(80e3, 1e3), adhesion)))


def test_a_notebook_shows_title_tables_and_notes_escaped():
    html = runs()._repr_html_()
    assert all(words in html for words in ("<b>2 runs</b>", "top speed, km/h", "95 % band"))
    hostile = Runs((Run("<script>", 1.0, None, None),))
    assert "<script>" not in hostile._repr_html_()
    refused(InputError, "Runs has no plot; print it, or use its attributes", runs().plot)


def test_csv_and_frame_hold_the_rows_in_si_units():
    found = runs()
    read = pd.read_csv(io.StringIO(found.to_csv()))
    assert read["top_speed_m_s"].tolist() == [20.0, 21.0]
    assert read["mass_std_kg"].isna().tolist() == [True, False]
    assert found.to_frame().attrs["units"]["top_speed_m_s"] == "m/s"
    refused(KeyError, "no table 'days'; it has runs", found.to_csv, name="days")


def test_a_narrow_terminal_leaves_out_the_least_important_columns_and_names_them():
    (table,) = runs().tables()
    for width, shown, left_out in (
        (80, "80.0 ± 2.0", ""),
        (34, "80.0 ± 2.0", "not shown in 34 columns: adhesion"),
        (24, "72.0", "mass, t, adhesion"),
    ):
        console = Console(width=width, file=io.StringIO())
        with console.capture() as captured:
            console.print(table)
        words = " ".join(captured.get().split())
        assert shown in words
        assert left_out in words
        assert ("not shown" in words) == (width < 80)
