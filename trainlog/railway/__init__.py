"""Lines, trains, running resistance, adhesion, track condition.

Pure data and pure functions on arrays; no files.
"""

from trainlog.railway.adhesion import CreepCurve as CreepCurve
from trainlog.railway.condition import TrackConditionMap as TrackConditionMap
from trainlog.railway.line import (
    CurvatureProfile as CurvatureProfile,
    Geometry as Geometry,
    Leg as Leg,
    Line as Line,
    LineReference as LineReference,
    Station as Station,
    StepProfile as StepProfile,
    Survey as Survey,
    Tunnel as Tunnel,
)
from trainlog.railway.network import Edge as Edge, Network as Network, Node as Node, Route as Route
from trainlog.railway.passport import Passport as Passport, Quantity as Quantity
from trainlog.railway.resistance import (
    EffortCurve as EffortCurve,
    RunningResistance as RunningResistance,
)
from trainlog.railway.train import (
    AxleGeometry as AxleGeometry,
    Axles as Axles,
    Brake as Brake,
    BrakingCurves as BrakingCurves,
    Configuration as Configuration,
    ParameterSet as ParameterSet,
    Train as Train,
)
from trainlog.railway.trajectory import (
    Journey as Journey,
    TimingPoint as TimingPoint,
    Trajectory as Trajectory,
)
