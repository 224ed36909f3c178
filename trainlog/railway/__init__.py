"""Lines, trains, running resistance, adhesion, track condition.

Pure data and pure functions on arrays; no files.
"""

from trainlog.railway.adhesion import CreepCurve as CreepCurve
from trainlog.railway.axle_loads import AxleGeometry as AxleGeometry
from trainlog.railway.condition import TrackConditionMap as TrackConditionMap
from trainlog.railway.effort import EffortCurve as EffortCurve
from trainlog.railway.journey import Journey as Journey, TimingPoint as TimingPoint
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
from trainlog.railway.resistance import RunningResistance as RunningResistance
from trainlog.railway.train import (
    Axles as Axles,
    Brake as Brake,
    BrakingCurves as BrakingCurves,
    Configuration as Configuration,
    ParameterSet as ParameterSet,
    Train as Train,
)
from trainlog.railway.trajectory import Trajectory as Trajectory
