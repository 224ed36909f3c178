"""Record train trips in a standard log, learn from them, and plan robust trajectories.

Examples
--------
>>> import trainlog
>>> trip = trainlog.read("sample_logs/nonstop.mcap")
>>> bool(trip["/train/state"].speed.max() > 30.0)
True

Frames are pandas DataFrames by topic, indexed by UTC time, in SI units (``frame.attrs["units"]``).
What is computed from trips is in the package `analysis`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainlog.public import names_on_first_use
from trainlog.version import __version__ as __version__

if TYPE_CHECKING:
    from trainlog.errors import (
        InfeasibleError as InfeasibleError,
    )
    from trainlog.errors import (
        InputError as InputError,
    )
    from trainlog.errors import (
        LogError as LogError,
    )
    from trainlog.errors import (
        MissingExtraError as MissingExtraError,
    )
    from trainlog.errors import (
        NotIdentifiableError as NotIdentifiableError,
    )
    from trainlog.errors import (
        TrainlogError as TrainlogError,
    )
    from trainlog.formats.condition import read_map as read_map
    from trainlog.formats.condition import write_map as write_map
    from trainlog.formats.line import (
        read_journey as read_journey,
    )
    from trainlog.formats.line import (
        read_line as read_line,
    )
    from trainlog.formats.line import (
        write_journey as write_journey,
    )
    from trainlog.formats.line import (
        write_line as write_line,
    )
    from trainlog.formats.parameters import (
        read_parameters as read_parameters,
    )
    from trainlog.formats.parameters import (
        write_parameters as write_parameters,
    )
    from trainlog.formats.parquet import (
        read_parquet as read_parquet,
    )
    from trainlog.formats.parquet import (
        write_parquet as write_parquet,
    )
    from trainlog.formats.samples import (
        DEFAULT_LINE as DEFAULT_LINE,
    )
    from trainlog.formats.samples import (
        DEFAULT_TRAIN as DEFAULT_TRAIN,
    )
    from trainlog.formats.samples import (
        sample as sample,
    )
    from trainlog.formats.train import (
        read_consist as read_consist,
    )
    from trainlog.formats.train import (
        read_train as read_train,
    )
    from trainlog.formats.train import (
        write_consist as write_consist,
    )
    from trainlog.formats.train import (
        write_train as write_train,
    )
    from trainlog.formats.trajectory import (
        read_trajectory as read_trajectory,
    )
    from trainlog.formats.trajectory import (
        write_trajectory as write_trajectory,
    )
    from trainlog.ingest import (
        ingest as read_recording,
    )
    from trainlog.ingest import (
        read_profile as read_profile,
    )
    from trainlog.ingest import (
        repairs_of as repairs_of,
    )
    from trainlog.ingest import (
        report_of as report_of,
    )
    from trainlog.mcap import (
        DamageWarning as DamageWarning,
    )
    from trainlog.mcap import (
        LogWriter as LogWriter,
    )
    from trainlog.mcap import (
        account_of as check,
    )
    from trainlog.mcap import (
        describe as describe,
    )
    from trainlog.mcap import (
        frames_of as frames,
    )
    from trainlog.mcap import (
        read_log as read,
    )
    from trainlog.mcap import (
        record as record,
    )
    from trainlog.mcap import (
        recover as recover,
    )
    from trainlog.mcap import (
        stream_log as stream,
    )
    from trainlog.mcap import (
        write_log as write,
    )
    from trainlog.railway import (
        Axles as Axles,
    )
    from trainlog.railway import (
        Brake as Brake,
    )
    from trainlog.railway import (
        Configuration as Configuration,
    )
    from trainlog.railway import (
        CurvatureProfile as CurvatureProfile,
    )
    from trainlog.railway import (
        Geometry as Geometry,
    )
    from trainlog.railway import (
        Journey as Journey,
    )
    from trainlog.railway import (
        Line as Line,
    )
    from trainlog.railway import (
        ParameterSet as ParameterSet,
    )
    from trainlog.railway import (
        RunningResistance as RunningResistance,
    )
    from trainlog.railway import (
        Station as Station,
    )
    from trainlog.railway import (
        StepProfile as StepProfile,
    )
    from trainlog.railway import (
        TimingPoint as TimingPoint,
    )
    from trainlog.railway import (
        TrackConditionMap as TrackConditionMap,
    )
    from trainlog.railway import (
        Train as Train,
    )
    from trainlog.railway import (
        Trajectory as Trajectory,
    )
    from trainlog.railway import (
        Tunnel as Tunnel,
    )
    from trainlog.railway.consist import Consist as Consist
    from trainlog.railway.consist import Coupler as Coupler
    from trainlog.railway.consist import Vehicle as Vehicle
    from trainlog.replay import (
        open_viewer as open_viewer,
    )
    from trainlog.replay import (
        scalars as scalars,
    )
    from trainlog.replay import (
        take_picture as take_picture,
    )
    from trainlog.replay import (
        write_layout as write_layout,
    )
    from trainlog.replay import (
        write_replay as write_replay,
    )
    from trainlog.resampling import joined as joined
    from trainlog.resampling import resampled as resampled
    from trainlog.simulation.consist import ConsistPlant as ConsistPlant
    from trainlog.simulation.recording import simulate as simulate
    from trainlog.simulation.scenario import (
        Scenario as Scenario,
    )
    from trainlog.simulation.scenario import (
        draw_scenarios as draw_scenarios,
    )
    from trainlog.simulation.scenario import (
        trajectory_scenarios as trajectory_scenarios,
    )
    from trainlog.trip import Trip as Trip
    from trainlog.trip import frame_of as frame_of

_NAMES = {
    "trainlog.mcap": (
        "read=read_log write=write_log record recover describe check=account_of "
        "stream=stream_log frames=frames_of LogWriter DamageWarning"
    ),
    "trainlog.formats.parquet": "read_parquet write_parquet",
    "trainlog.trip": "Trip frame_of",
    "trainlog.resampling": "joined resampled",
    "trainlog.ingest": "read_recording=ingest report_of repairs_of read_profile",
    "trainlog.railway": (
        "Configuration CurvatureProfile Geometry Journey Line ParameterSet "
        "RunningResistance Station StepProfile TimingPoint TrackConditionMap Train "
        "Trajectory Tunnel Axles Brake"
    ),
    "trainlog.railway.consist": "Consist Coupler Vehicle",
    "trainlog.formats.line": "read_line write_line read_journey write_journey",
    "trainlog.formats.train": "read_train write_train read_consist write_consist",
    "trainlog.formats.condition": "read_map write_map",
    "trainlog.formats.parameters": "read_parameters write_parameters",
    "trainlog.formats.trajectory": "read_trajectory write_trajectory",
    "trainlog.formats.samples": "DEFAULT_LINE DEFAULT_TRAIN sample",
    "trainlog.simulation.scenario": "Scenario draw_scenarios trajectory_scenarios",
    "trainlog.simulation.recording": "simulate",
    "trainlog.simulation.consist": "ConsistPlant",
    "trainlog.replay": "open_viewer scalars take_picture write_layout write_replay",
    "trainlog.errors": (
        "InfeasibleError InputError LogError MissingExtraError NotIdentifiableError TrainlogError"
    ),
}
"""Public names by the module that defines them; ``public=name`` where it has another name there."""

__all__, __getattr__, __dir__ = names_on_first_use(__name__, _NAMES)
