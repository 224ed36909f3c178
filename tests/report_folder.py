"""A folder of results of every kind, with names that are none of a page's business."""

import shutil
from dataclasses import replace
from pathlib import Path

from analysis import OptimiserOptions, TrajectoryProblem, fit, optimise
from analysis.studies.report import as_markdown
from trainlog import read_line, read_train, sample, write_parameters, write_trajectory
from trainlog.formats.railway import line_from_bytes, line_to_bytes
from trainlog.formats.summaries import write_summaries
from trainlog.mcap import read_log, write_log
from trainlog.presentation import new_table
from trainlog.railway import Configuration, Station, Trajectory
from trainlog.trip import LINE_ATTACHMENT, Trip

SCRIPT = "<script>document.title='taken'</script>"  # what a name must not do


def hostile_trip() -> Trip:
    """The sample trip with stops, under names of trip and station that are code of a page."""
    trip = read_log(sample("stopping.mcap"))
    line = line_from_bytes(trip.attachments[LINE_ATTACHMENT])
    known = line.stations
    stations = [Station(SCRIPT, x.position) if x.name == "Flawil" else x for x in known]
    attached = {LINE_ATTACHMENT: line_to_bytes(replace(line, stations=tuple(stations)))}
    metadata = {**trip.metadata, "trip": SCRIPT, "weather": "<img src=x onerror=alert(1)>"}
    return replace(trip, metadata=metadata, attachments={**trip.attachments, **attached})


def planned() -> Trajectory:
    """From St.Gallen to Gossau, for the train as its file describes it."""
    line = read_line(sample("CH_StGallen_Wil.line.json"))
    train = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    problem = TrajectoryProblem(line, train, [Configuration.of(train)], end=9_286.1)
    return optimise(problem, OptimiserOptions(cells=60))


def make_folder(folder: Path) -> Path:
    """A fit with its log, a map, a trajectory, a study, and a log that is none."""
    (folder / "trips").mkdir(parents=True)
    write_log(hostile_trip(), folder / "trips" / "a<b>&.mcap")
    (folder / "trips" / "none.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(200))
    fits = fit(sample("nonstop.mcap"))
    write_parameters(fits.parameters, folder / "parameters.json")
    write_summaries(fits.summaries, folder / "parameters.parquet")
    shutil.copy(sample("CH_StGallen_Wil.map"), folder / "wil.map")
    write_trajectory(planned(), folder / "trajectory.json")
    study = folder / "study"
    study.mkdir()
    table = new_table("Errors", "estimator", "kN")
    table.add_row("forgetting", "0.31")
    (study / "tables.md").write_text(as_markdown(table), encoding="utf-8")
    return folder
