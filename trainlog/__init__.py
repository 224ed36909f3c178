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

from trainlog.extras import names_on_first_use
from trainlog.version import __version__ as __version__

if TYPE_CHECKING:
    from trainlog.errors import (
        InfeasibleError as InfeasibleError,
        InputError as InputError,
        LogError as LogError,
        MissingExtraError as MissingExtraError,
        NotIdentifiableError as NotIdentifiableError,
        NotRecordedError as NotRecordedError,
        TrainlogError as TrainlogError,
    )
    from trainlog.formats.characteristic import (
        read_characteristic as read_characteristic,
        write_characteristic as write_characteristic,
    )
    from trainlog.formats.csv_tables import (
        read_forecast as read_forecast,
        read_weather as read_weather,
        write_forecast as write_forecast,
        write_weather as write_weather,
    )
    from trainlog.formats.mapfile import read_map as read_map, write_map as write_map
    from trainlog.formats.railway import (
        read_consist as read_consist,
        read_journey as read_journey,
        read_line as read_line,
        read_network as read_network,
        read_parameters as read_parameters,
        read_train as read_train,
        read_trajectory as read_trajectory,
        write_consist as write_consist,
        write_journey as write_journey,
        write_line as write_line,
        write_network as write_network,
        write_parameters as write_parameters,
        write_train as write_train,
        write_trajectory as write_trajectory,
    )
    from trainlog.formats.samples import (
        DEFAULT_LINE as DEFAULT_LINE,
        DEFAULT_TRAIN as DEFAULT_TRAIN,
        sample as sample,
    )
    from trainlog.formats.trip_tables import (
        read_parquet as read_parquet,
        write_parquet as write_parquet,
    )
    from trainlog.identity import identity_of as identity_of
    from trainlog.ingest import (
        ingest,
        read_profile as read_profile,
        repairs_of as repairs_of,
        report_of as report_of,
    )
    from trainlog.mcap import (
        DamageWarning as DamageWarning,
        LogWriter as LogWriter,
        OverloadWarning as OverloadWarning,
        Recording as Recording,
        account_of,
        describe as describe,
        frames_of,
        read_log,
        record as record,
        recover as recover,
        stream_log,
        write_log,
    )
    from trainlog.railway import (
        AxleGeometry as AxleGeometry,
        Axles as Axles,
        Brake as Brake,
        Configuration as Configuration,
        CurvatureProfile as CurvatureProfile,
        Edge as Edge,
        Geometry as Geometry,
        Journey as Journey,
        Leg as Leg,
        Line as Line,
        LineReference as LineReference,
        Network as Network,
        Node as Node,
        ParameterSet as ParameterSet,
        Route as Route,
        RunningResistance as RunningResistance,
        Station as Station,
        StepProfile as StepProfile,
        TimingPoint as TimingPoint,
        TrackConditionMap as TrackConditionMap,
        Train as Train,
        Trajectory as Trajectory,
        Tunnel as Tunnel,
    )
    from trainlog.railway.adhesion import (
        AdhesionCharacteristic as AdhesionCharacteristic,
        AdhesionPoints as AdhesionPoints,
        AdhesionTable as AdhesionTable,
        CreepCurve as CreepCurve,
        PolachCurve as PolachCurve,
        polach_curve as polach_curve,
    )
    from trainlog.railway.train import (
        Consist as Consist,
        ConsistBrake as ConsistBrake,
        Coupler as Coupler,
        Vehicle as Vehicle,
    )
    from trainlog.railway.weather import Weather as Weather
    from trainlog.replay import (
        ReplayOptions as ReplayOptions,
        live_replay as live_replay,
        open_viewer as open_viewer,
        run_viewer as run_viewer,
        scalars as scalars,
        take_picture as take_picture,
        write_layout as write_layout,
        write_replay as write_replay,
    )
    from trainlog.resampling import joined as joined, resampled as resampled
    from trainlog.simulation.consist import ConsistPlant as ConsistPlant
    from trainlog.simulation.fleet import (
        Fleet as Fleet,
        draw_fleet as draw_fleet,
        write_fleet as write_fleet,
    )
    from trainlog.simulation.network import draw_network as draw_network
    from trainlog.simulation.rail import Change, Rail as Rail
    from trainlog.simulation.recording import simulate as simulate
    from trainlog.simulation.scenario import (
        Scenario as Scenario,
        draw_days as draw_days,
        draw_scenarios as draw_scenarios,
        trajectory_scenarios as trajectory_scenarios,
    )
    from trainlog.simulation.vehicles import Fault
    from trainlog.topics import Field, recorded_topic as recorded_topic
    from trainlog.trip import Trip as Trip, frame_of as frame_of

    # Type checkers take an assigned name, not one imported under another, for a public one.
    RailChange = Change
    TopicField = Field
    TrainFault = Fault
    check = account_of
    frames = frames_of
    read = read_log
    read_recording = ingest
    stream = stream_log
    write = write_log

if not TYPE_CHECKING:  # type checkers refuse names that are not listed above
    __all__, __getattr__, __dir__ = names_on_first_use(__name__, __file__)
