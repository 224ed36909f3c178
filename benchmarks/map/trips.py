"""Trips over weeks on a rail that changes, for benchmarks of the track-condition map.

    python benchmarks/map/trips.py [--days 30] [--trips-per-day 4] [--seed 1] [--cache FOLDER]

prints what is drawn. Other benchmarks import it (``from trips import months, add_options``):

- `railways(library)`: three lines and three trains; those of TTOBench only where the library is.
- `month(line, trains, days, trips_a_day, seed, changes, cache=folder)`: a `Month`: its `rail`
  (`trainlog.simulation.rail.Rail`: lasting adhesion, spots, weather, changes) and its `drives`, in
  order of time. A `Drive` holds `name`, `time` [ns], `layer`, `analysis` (`SlipAnalysis`), `met`
  (what the trip met), `lasting` (what lasts in its layer at its time), both `StepProfile`, and
  `evidence(track)`.
- `months(options)`: one a line, with the trains taking turns on it; `add_options(parser)` adds
  ``--days --trips-per-day --seed --start --library --cache --change``.

A heavy train that a slippery climb stops for good is skipped and listed.

``--cache FOLDER``: what slip analysis makes of each trip is kept there, by the contents of the
modules that simulate and analyse, of line, trains and options: it is never stale, and a second run
takes seconds. Keep the folder out of the repository. 100 trips take about a minute without it.
"""

from __future__ import annotations

import argparse
import hashlib
import pickle
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

import analysis
import estimators
import trainlog
from analysis.adhesion.evidence import Evidence, evidence_of
from analysis.adhesion.slip import SlipAnalysis, slip
from trainlog.errors import InfeasibleError
from trainlog.formats.railway import line_to_bytes, read_line, read_train, train_to_bytes
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.formats.ttobench import read_track, read_train as read_foreign_train
from trainlog.railway import Line, StepProfile, TrackConditionMap, Train
from trainlog.simulation import simulate
from trainlog.simulation.rail import Change, Rail
from trainlog.simulation.scenario import Scenario, draw_days

LIBRARY = Path(__file__).resolve().parent / "../../../shared/data/ttobench"
"""TTOBench beside the checkout; another place with ``--library``."""

PARTS = ("simulation/*.py", "railway/*.py", "formats/railway.py")
"""Of `trainlog`: what a simulated trip depends on."""

ANALYSIS = ("adhesion/slip.py", "adhesion/events.py", "adhesion/axles.py")
"""Of `analysis`: what the analysis of its slip depends on."""


@dataclass(frozen=True, eq=False)
class Drive:
    """One trip, as its analysis and as its truth show it."""

    name: str
    time: int
    layer: str
    train: str
    analysis: SlipAnalysis
    met: StepProfile
    lasting: StepProfile

    def evidence(self, track: TrackConditionMap) -> Evidence:
        """What it says of the map's line."""
        return evidence_of(self.analysis, track, self.layer, sha256=self.name)


@dataclass(frozen=True, eq=False)
class Month:
    """A rail and the trips on it, in order of time."""

    rail: Rail
    drives: tuple[Drive, ...]

    @property
    def line(self) -> Line:
        """Whose rail it is."""
        return self.rail.line


def railways(library: Path = LIBRARY) -> tuple[list[Line], list[Train]]:
    """Three lines and three trains; without the library the sample line and train alone."""
    lines, trains = [read_line(sample(DEFAULT_LINE))], [read_train(sample(DEFAULT_TRAIN))]
    if not library.is_dir():
        print(f"skipped: two lines and two trains, {library} is not there")
        return lines, trains
    lines += [
        read_track(library / "tracks" / f"{name}.json")
        for name in ("CH_Stadelhofen_Altstetten", "00_reference")
    ]
    trains += [
        read_foreign_train(library / "trains" / f"{name}.json")
        for name in ("CH_Stadler_KISS_SBB", "NL_Intercity_VIRM6")
    ]
    return lines, trains


def month(
    line: Line,
    trains: Sequence[Train],
    days: int = 30,
    trips_a_day: int = 4,
    seed: int = 1,
    changes: Sequence[Change] = (),
    *,
    start: str = "2026-10-10",
    cache: Path | None = None,
) -> Month:
    """A rail over `days`, and the trips on it."""
    rail = Rail.draw(line, days, start, seed, changes)
    scenarios = draw_days(rail, trains, trips_a_day)
    code = _code()
    drives = []
    for scenario in scenarios:
        try:
            drives.append(_driven(scenario, code, cache))
        except InfeasibleError as error:
            print(f"skipped: {line.name}, {scenario.train.name}: {error.problem}")
    return Month(rail, tuple(drives))


def _driven(scenario: Scenario, code: bytes, cache: Path | None) -> Drive:
    content = (code, line_to_bytes(scenario.line), train_to_bytes(scenario.train), scenario.truth())
    key = hashlib.sha256(b"\0".join(content) + str(scenario.start).encode()).hexdigest()
    kept = None if cache is None else cache / f"{key}.slip"
    if kept is not None and kept.exists():
        found = pickle.loads(zlib.decompress(kept.read_bytes()))
    else:
        found = slip(simulate(scenario))
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            part = kept.with_suffix(".part")
            part.write_bytes(zlib.compress(pickle.dumps(found), 1))
            part.replace(kept)
    assert scenario.state is not None
    return Drive(
        scenario.name,
        scenario.start,
        scenario.weather,
        scenario.train.name,
        found,
        scenario.maximum_adhesion,
        scenario.state.lasting,
    )


def _code() -> bytes:
    """Digest of the modules that make an analysed trip."""
    roots = ((trainlog, PARTS), (analysis, ANALYSIS), (estimators, ("*.py",)))
    files = [
        path
        for package, parts in roots
        for part in parts
        for path in sorted(Path(str(package.__file__)).parent.glob(part))
    ]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).digest()


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of `months`."""
    parser.add_argument("--days", type=int, default=30)
    parser.add_argument("--trips-per-day", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start", default="2026-10-10")
    parser.add_argument("--lines", type=int, default=3, help="the first so many of three")
    parser.add_argument("--library", type=Path, default=LIBRARY)
    parser.add_argument("--cache", type=Path, help="folder for analysed trips")
    parser.add_argument(
        "--change",
        type=float,
        nargs=2,
        metavar=("DAY", "FACTOR"),
        help="from that day on the second fifth of each line holds so much of what it held",
    )


def months(options: argparse.Namespace) -> Iterator[Month]:
    """The month of each line, all trains taking turns on it."""
    lines, trains = railways(options.library)
    for line in lines[: options.lines]:
        changes = []
        if options.change:
            day, factor = options.change
            when = pd.Timestamp(options.start, tz="UTC") + pd.Timedelta(days=day)
            changes = [Change(0.2 * line.length, 0.4 * line.length, when.value, factor)]
        yield month(
            line,
            trains,
            options.days,
            options.trips_per_day,
            options.seed,
            changes,
            start=options.start,
            cache=options.cache,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_options(parser)
    for each in months(parser.parse_args()):
        print(each.rail)
        onsets = sum(int(drive.analysis.events["measured"].sum()) for drive in each.drives)
        layers = Counter(drive.layer for drive in each.drives)
        alive = [np.sum(each.rail.left(drive.time) > 0.5) for drive in each.drives]
        print(f"  trips    {len(each.drives)}: {', '.join(f'{n} {k}' for k, n in layers.items())}")
        print(f"  onsets   {onsets} measured; {np.mean(alive):.1f} spots that a trip may meet")


if __name__ == "__main__":
    main()
