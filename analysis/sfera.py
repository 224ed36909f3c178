"""What goes out in messages of SFERA: a driver's advice, the rail's condition, a trip's reports."""

from __future__ import annotations

import datetime
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import pandas as pd

from analysis.adhesion.axles import protection_onsets
from analysis.reports.summary import content_of
from analysis.trajectory.advice import JourneyAdvice, journey_advice, limits_of
from analysis.trajectory.instructions import Phase, limits_between
from analysis.view import with_chainage
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import InputError, LogError
from trainlog.formats.csv_tables import read_forecast
from trainlog.formats.declared import built
from trainlog.formats.files import atomic_write, write_bytes
from trainlog.formats.railml import Element
from trainlog.formats.railway import line_of, read_parameters, read_trajectory
from trainlog.formats.sfera import SferaJourney, documents_in, is_sfera, places_along, read_journey
from trainlog.formats.sfera_messages import (
    DRY,
    Constraint,
    Report,
    advice_message,
    category_of,
    status_report,
    with_constraints,
    with_resistance,
    xml_of,
)
from trainlog.ingest.sources import Publication
from trainlog.mcap.reader import read_log
from trainlog.progress import track
from trainlog.railway import Line, Trajectory
from trainlog.railway.condition import AdhesionForecast
from trainlog.resampling import interpolated_columns
from trainlog.topics import TRAIN_STATE
from trainlog.trip import LINE_ATTACHMENT, Trip
from trainlog.units import KMH, NANOSECONDS

SENDER = "trainlog"
"""Name of the device that sends messages."""

KINDS = {
    Phase.MAXIMUM_TRACTION: "AccelerationAdvice",
    Phase.CRUISING: "AccelerationAdvice",
    Phase.COASTING: "CoastingAdvice",
    Phase.PARTIAL_BRAKING: "OperationalBrakingAdvice",
    Phase.MAXIMUM_BRAKING: "OperationalBrakingAdvice",
}
"""Kind of advice by phase, where no speed is to be held."""

PROBABILITY = 0.05
"""With which the rail is worse than the category that is said of it."""


GAP = 5.0
"""Between samples that are so many times further apart than usual, a train reports nothing."""

CHANGES_APART = 10.0
"""Changes of the advised speed follow each other by no less [s]."""


@dataclass(frozen=True)
class Advised:
    """What a driver is advised over a stretch of a journey.

    Attributes
    ----------
    begin, end : float [m]
        Along the journey.
    time, until : float [s]
        At its begin and end, since the first departure, as planned.
    phase : Phase
    hold : bool
        Whether the speed is to be held; else it is that at the end of the stretch.
    speed : int [km/h]
        Nowhere above a limit of the stretch; 0: a stop.
    permitted : float [km/h]
        The limit of the stretch.
    """

    begin: float
    end: float
    time: float
    until: float
    phase: Phase
    hold: bool
    speed: int
    permitted: float = np.inf

    @property
    def advice(self) -> dict[str, str]:
        """Kind, speed and reason, as SFERA has them."""
        braking = self.phase in (Phase.PARTIAL_BRAKING, Phase.MAXIMUM_BRAKING)
        kind = "ConstantspeedAdvice" if self.hold else KINDS[self.phase]
        stated = {"adviceType": kind, "optimalSpeed": str(self.speed)}
        if braking and not self.speed:
            stated = {"adviceType": "StopAdvice"}
        return stated | {"reasonCode": "energyOptimisation"}


def advised(
    advice: JourneyAdvice,
    journey: SferaJourney,
    *,
    changes_apart: float = CHANGES_APART,
    passed: float = 0.0,
) -> list[Advised]:
    """A driver's advice as speeds that are advised, one stretch after the other.

    A stretch with a limit below its speed is divided there. Where two would follow each other
    sooner than changes may, a lower speed begins with the first, and a higher one waits, as does
    coasting behind traction where the limit is no lower; a train that has stopped departs at any
    time.

    Parameters
    ----------
    advice : JourneyAdvice
        Planned on the journey's line.
    journey : SferaJourney
    changes_apart : float [s]
        Changes follow each other by no less.
    passed : float [m]
        Where the train is: there is no advice for what lies behind it.

    Raises
    ------
    InputError
        If the advice is for another line.
    """
    own, line = advice.line, journey.line
    if own.name != line.name or abs(own.length - line.length) > 1.0:
        raise InputError(
            f"the trajectory is planned on line '{own.name}', the journey's is '{line.name}'",
            remedy="plan on the line that 'trainlog import' makes of the journey",
        )
    for section in advice.sections:
        _check_limits(section, own, line)
    found = list[Advised]()
    for each in _divided(advice, line):
        if each.end <= passed + _SHORT:
            continue
        part = replace(each, begin=max(each.begin, passed))
        last = found[-1] if found else None
        if last is not None and last.advice == part.advice:
            found[-1] = replace(last, end=part.end, until=part.until)
            continue
        # Behind a stop the train departs, however soon.
        if last is not None and last.speed and part.time - last.time < changes_apart:
            gained = last.phase <= Phase.CRUISING and not last.hold
            coasts = gained and part.phase is Phase.COASTING and last.speed <= part.permitted
            if part.speed <= last.speed and not coasts:
                part = replace(part, begin=last.begin, time=last.time)
                found.pop()
            else:
                until = min(last.time + changes_apart, part.until)
                at = float(np.interp(until, (part.time, part.until), (part.begin, part.end)))
                found[-1] = replace(last, end=at, until=until)
                if until == part.until:
                    continue
                part = replace(part, begin=at, time=until)
        found.append(part)
    if not found:
        end = max(float(each.positions[-1]) for each in advice.sections)
        raise InputError(
            f"the train is at km {passed / 1e3:.3f}, the plan ends at km {end / 1e3:.3f}",
            remedy="give a place before the plan's end with --passed",
        )
    return found


def _check_limits(section: Trajectory, planned: Line, line: Line) -> None:
    """Refuse a plan that counts on higher limits than the journey has."""
    ends = section.positions[[0, -1]]
    places = np.concatenate((planned.speed_limits.positions, line.speed_limits.positions, ends))
    places = np.unique(places[(places >= ends[0]) & (places < ends[1])])
    over = places[planned.speed_limit(places) > line.speed_limit(places) + 0.1 / KMH]
    if over.size:
        was, now = (KMH * float(each.speed_limit(over[0])) for each in (planned, line))
        raise InputError(
            f"the trajectory is planned for {was:.0f} km/h at km {over[0] / 1e3:.3f}, the"
            f" journey's limit is {now:.0f} km/h",
            remedy="import the journey again, and plan on its line",
        )


_SHORT = 1.0
"""Shorter stretches are not advised [m]."""


def _divided(advice: JourneyAdvice, line: Line) -> Iterator[Advised]:
    """The stretches of an advice, each with a speed that no limit in it is below."""
    for section, departure in zip(advice.sections, advice.departures.tolist(), strict=True):
        limits, times = limits_of(section, line), section.times[section.latest]
        begin, end = float(section.positions[0]), float(section.positions[-1])
        for row in advice.rows:
            own = row.instruction
            if own is None or not begin - _SHORT <= own.position < end - _SHORT:
                continue
            for each in limits_between(limits, own.position, own.end):
                ends = np.interp((each.start, each.end), section.positions, times)
                time, until = (departure + ends).tolist()
                speed = round(KMH * min(own.stated_target, each.speed))
                stated, limit = (own.phase, own.hold, speed), KMH * each.speed
                yield Advised(each.start, each.end, time, until, *stated, limit)


def advice_constraints(found: Iterable[Advised]) -> list[Constraint]:
    """Advised speeds and power as temporary constraints of a journey."""
    rows = list[Constraint]()
    for each in found:
        rows.append(Constraint(each.begin, each.end, "AdvisedSpeed", each.advice))
        power = {Phase.MAXIMUM_TRACTION: "Maximise", Phase.COASTING: "Minimise"}.get(each.phase)
        if power is not None and not each.hold:
            change = {"powerConsumptionChange": power}
            rows.append(Constraint(each.begin, each.end, "PowerAdvice", change))
    return rows


def low_adhesion(
    forecast: AdhesionForecast,
    journey: SferaJourney,
    own: Line | None = None,
    *,
    layer: str = "",
    probability: float = PROBABILITY,
) -> list[Constraint]:
    """A forecast of the rail as constraints by stretch and time.

    Dry rail is not stated, nor is rail of which the forecast knows nothing.

    Parameters
    ----------
    forecast : AdhesionForecast
    journey : SferaJourney
    own : Line, optional
        The forecast's line, where it is not the journey's: places are the same by the operator's
        kilometre or the names of stations.
    layer : str
        Rail condition that is expected; empty: rows for any.
    probability : float
        With which the adhesion is worse than the category that is stated.

    Raises
    ------
    InputError
        If the forecast does not state this quantile, or is for another line than those given.
    """
    column = np.flatnonzero(np.isclose(forecast.shares, probability))
    if not column.size:
        known = ", ".join(f"{share:g}" for share in forecast.shares)
        raise InputError(
            f"the forecast does not state the quantile {probability:g}",
            remedy=f"it states {known or 'none'}",
        )
    conditions = sorted(set(forecast.layer))
    if layer not in conditions and "" not in conditions:
        raise InputError(
            f"the forecast states nothing of rail that is '{layer}'" if layer
            else "the forecast's rows are each for one rail condition, and none was named",
            remedy=f"name one with --layer: {', '.join(conditions)}",
        )  # fmt: skip
    along = _along(journey, forecast.line, own)
    ends = np.sort([along(forecast.start), along(forecast.end)], axis=0)
    values = forecast.quantiles[:, column[0]]
    named = np.array([name in ("", layer) for name in forecast.layer])
    kept = named & np.isfinite(values) & np.isfinite(ends).all(axis=0)
    given = (forecast.valid_from, forecast.valid_to, *ends, values)
    found = list[Constraint]()
    for begin, until, at, end, value in sorted(
        zip(*(e[kept].tolist() for e in given), strict=True)
    ):
        words = {"lowAdhesionCategory": category_of(value)}
        if words["lowAdhesionCategory"] == DRY:
            continue
        start, stop = _utc(begin), _utc(until)
        row = Constraint(at, end, "Low_Adhesion", words, "LowAdhesion", start, stop)
        before = found[-1] if found else None
        if (
            before is not None
            and (before.start, before.attributes) == (start, words)
            and at - before.end <= _SHORT
        ):
            row = replace(row, begin=found.pop().begin)
        found.append(row)
    return found


def _along(
    journey: SferaJourney, name: str | None, own: Line | None
) -> Callable[[FloatArray], FloatArray]:
    """Positions along a journey of positions on a line of one's own; NaN beside it."""
    if name is None or name == journey.line.name:
        length = journey.line.length
        return lambda at: np.where((at >= 0.0) & (at <= length), at, np.nan)
    if own is None or own.name != name:
        but = "" if own is None else f", the line given is '{own.name}'"
        raise InputError(
            f"it is of line '{name}', the journey's is '{journey.line.name}'{but}",
            remedy=f"give the line file of '{name}' with --line",
        )
    return places_along(journey.line, own)


def _utc(time: int) -> datetime.datetime:
    return pd.Timestamp(time, tz="UTC").to_pydatetime(warn=False)


def reports_of(
    trip: Trip, journey: SferaJourney, own: Line | None = None, every: float = 5.0
) -> list[Report]:
    """A trip as a train's reports: where it is, how fast, and whether its wheels slip or slide.

    Parameters
    ----------
    trip : Trip
        With ``/train/state``.
    journey : SferaJourney
    own : Line, optional
        The trip's line as travelled, where it is not the journey's.
    every : float [s]
        There are no reports in gaps of the recording.

    Raises
    ------
    LogError
        If the trip holds no position or speed, or none on the journey.
    """
    if TRAIN_STATE.name not in trip:
        raise LogError(f"has no {TRAIN_STATE.name}", remedy="give a log of a train's motion")
    state = with_chainage(trip)[TRAIN_STATE.name][["position", "speed"]].dropna()
    along = _along(journey, trip.metadata.get("line"), own)
    state = state.assign(position=along(state.position.to_numpy())).dropna()
    if len(state) < 2:
        raise LogError("is nowhere on the journey", remedy="give a trip over the journey's line")
    known = pd.DatetimeIndex(state.index).as_unit("ns").asi8
    step = int(every * NANOSECONDS)
    # Messages state whole seconds.
    first = -(-known[0] // NANOSECONDS) * NANOSECONDS
    times = np.unique(np.arange(first, known[-1] + 1, step) // NANOSECONDS) * NANOSECONDS
    gap = max(every, GAP * float(np.median(np.diff(known))) / NANOSECONDS)
    clock = pd.DatetimeIndex(times, tz="UTC")
    at, speed = interpolated_columns(state, ["position", "speed"], clock, gap)
    recorded = np.isfinite(at)
    times, at, speed = times[recorded], at[recorded], speed[recorded]
    slips = _slips(trip, times, step)
    return [
        Report(_utc(time), place, max(v, 0.0), None if slips is None else bool(slips[number]))
        for number, (time, place, v) in enumerate(
            zip(times.tolist(), at.tolist(), speed.tolist(), strict=True)
        )
    ]


def _slips(trip: Trip, times: IntArray, every: int) -> BoolArray | None:
    """Whether slip protection acted in the time before each report; None if nothing notes it."""
    onsets = protection_onsets(trip)
    if onsets is None:
        return None
    when = onsets.as_unit("ns").asi8
    before = np.searchsorted(when, times - every, side="right")
    return np.asarray(np.searchsorted(when, times, side="right") > before)


# --------------------------------------------------------------------------------------- written


@dataclass(frozen=True)
class SferaOptions:
    """How results become messages; the values of `advised`, `low_adhesion` and `reports_of`.

    Reports of a trip are published, too, to the topic of a broker, `pace` times as fast as it ran.
    """

    line: Line | None = None
    layer: str = ""
    probability: float = PROBABILITY
    changes_apart: float = CHANGES_APART
    passed: float | None = None
    every: float = 5.0
    publish: str | None = None
    pace: float = 1.0


def write_sfera(
    sources: Sequence[Path],
    journey: str | Path,
    output: str | Path,
    options: SferaOptions = SferaOptions(),
) -> dict[str, object]:
    """Write results into the documents of a journey of SFERA, or as messages.

    - Trajectories: the journey's next version with advised speeds and power; with `passed` a
      message of advice for what lies ahead of the train.
    - A forecast of adhesion (.csv): the journey's next version with low adhesion.
    - A parameter set: the next version of the train's characteristics, with the resistance of all
      trips together.
    - A trip (.mcap): an archive of the journey's documents and the train's status reports.

    Parameters
    ----------
    sources : sequence of Path
        Of one kind; but for the sections of a journey only one.
    journey : path
        A file, folder or archive with one journey.
    output : path
        ``.xml``; of a trip ``.zip``.
    options : SferaOptions

    Returns
    -------
    dict
        What was written, by its name.

    Raises
    ------
    InputError
        If the journey or a source cannot be read, does not fit the journey, or is of no such kind.
    """
    own, first = read_journey(journey), Path(sources[0])
    kind = "forecast" if first.suffix.lower() == ".csv" else content_of(first)
    if kind not in (*_WRITERS, "trip"):
        raise InputError(
            f"cannot be written to SFERA{f', but a {kind} file' if kind else ''}",
            file=first,
            remedy="give trajectories, a forecast (.csv), a parameter set or a trip (.mcap)",
        )
    for name, of in (("passed", "trajectory"), ("layer", "forecast"), ("publish", "trip")):
        if getattr(options, name) not in (None, "") and kind != of:
            raise InputError(
                f"--{name} goes with a {of}, given is a {kind}", remedy=f"leave --{name} out"
            )
    if len(sources) > 1 and kind != "trajectory":
        raise InputError("several files are given", remedy=f"name one {kind} file")
    wanted = ".zip" if kind == "trip" else ".xml"
    if Path(output).suffix.lower() != wanted:
        raise InputError(
            f"is not the name of a {wanted} file", file=output, remedy=f"end it in {wanted}"
        )
    if kind == "trip":
        return _write_reports(first, own, Path(journey), output, options)
    document, said = _WRITERS[kind](sources, own, options)
    write_bytes(output, xml_of(document))
    return {"journey": own.name, **said}


_Written = tuple[Element, dict[str, object]]


def _with_advice(sources: Sequence[Path], own: SferaJourney, options: SferaOptions) -> _Written:
    rows = advised(
        journey_advice([read_trajectory(each) for each in sources]),
        own,
        changes_apart=options.changes_apart,
        passed=options.passed or 0.0,
    )
    found, said = advice_constraints(rows), {"advised_speeds": len(rows)}
    if options.passed is None:
        profile = with_constraints(own.profile, own.segments, found, "AdvisedSpeed", "PowerAdvice")
        return profile, {**said, "version": profile.text("JP_Version")}
    ahead = [each for each in found if each.kind == "AdvisedSpeed"]
    now = datetime.datetime.now(datetime.UTC)
    return advice_message(own.profile, own.segments, ahead, now, SENDER), dict(said)


def _with_low_adhesion(
    sources: Sequence[Path], own: SferaJourney, options: SferaOptions
) -> _Written:
    forecast = read_forecast(sources[0])
    of = partial(low_adhesion, layer=options.layer, probability=options.probability)
    rows = built(lambda: of(forecast, own, options.line), sources[0])
    profile = with_constraints(own.profile, own.segments, rows, "Low_Adhesion")
    said: dict[str, object] = {"stretches_of_low_adhesion": len(rows)}
    return profile, said | _dated(rows[0].start if rows else None, own)


def _dated(time: datetime.datetime | None, journey: SferaJourney) -> dict[str, object]:
    """The day of a result, where it is not the journey's."""
    runs = re.search(r"\d{4}-\d\d-\d\d", journey.name)
    if time is None or runs is None or (day := f"{time:%Y-%m-%d}") == runs[0]:
        return {}
    return {"dated": f"{day}, the journey is of {runs[0]}"}


def _with_learned(sources: Sequence[Path], own: SferaJourney, _: SferaOptions) -> _Written:
    learned = read_parameters(sources[0])
    if learned.common is None:
        raise InputError(
            "the parameter set has no fit of all trips together",
            remedy="fit two trips or more with 'trainlog fit'",
        )
    if own.characteristics is None:
        raise InputError(
            "the journey names no train characteristics",
            remedy="add TrainCharacteristicsRef, and the document that it names",
        )
    now = datetime.datetime.now(datetime.UTC)
    found = with_resistance(own.characteristics, learned.common, now)
    return found, {
        "train": learned.train,
        "version_of_characteristics": found.text("TC_VersionMinor"),
    }


_WRITERS = {
    "trajectory": _with_advice, "forecast": _with_low_adhesion, "parameters": _with_learned,
}  # fmt: skip
"""What makes a document of what is given."""


def _write_reports(
    log: Path, own: SferaJourney, journey: Path, output: str | Path, options: SferaOptions
) -> dict[str, object]:
    trip = read_log(log)
    line = options.line
    if line is None and LINE_ATTACHMENT in trip.attachments:
        line = line_of(trip)
    reports = reports_of(trip, own, line, options.every)
    messages = [xml_of(status_report(each, own.segments, own.profile, SENDER)) for each in reports]
    broker = None if options.publish is None else Publication(options.publish)
    with atomic_write(output) as path, ZipFile(path, "w", ZIP_DEFLATED) as archive:
        for name, data in documents_in(journey):
            if is_sfera(data):
                archive.writestr(Path(name).name, data)
        for number, message in enumerate(messages, 1):
            archive.writestr(f"report-{number:05d}.xml", message)
    said: dict[str, object] = {"journey": own.name, "reports": len(reports)}
    if broker is not None:
        first = reports[0].time
        waits = [(each.time - first).total_seconds() / options.pace for each in reports]
        _publish(messages, waits, broker)
        said["published"] = len(messages)
    return said | _dated(reports[0].time, own)


def _publish(messages: Sequence[bytes], waits: Sequence[float], broker: Publication) -> None:
    """Give each message to a broker, so long after the first [s]."""
    begun = time.monotonic()
    try:
        for wait, message in track(list(zip(waits, messages, strict=True)), "publishing", "report"):
            time.sleep(max(begun + wait - time.monotonic(), 0.0))
            broker.publish(message)
    finally:
        left = broker.close()
    if left:
        where = f"{broker.host}:{broker.port}"
        raise InputError(
            f"the broker {where} did not take {left} of {len(messages)} reports",
            remedy="start it, and publish again; the archive holds them all",
        )
