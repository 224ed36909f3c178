"""Lines, trains, running resistance, adhesion, track condition.

Pure data and pure functions on arrays; no files.
"""

from trainlog.railway.adhesion import CreepCurve
from trainlog.railway.axle_loads import AxleGeometry
from trainlog.railway.condition import TrackConditionMap
from trainlog.railway.effort import EffortCurve
from trainlog.railway.journey import Journey, TimingPoint
from trainlog.railway.line import (
    CurvatureProfile,
    Geometry,
    Leg,
    Line,
    LineReference,
    Station,
    StepProfile,
    Survey,
    Tunnel,
)
from trainlog.railway.network import Edge, Network, Node, Route
from trainlog.railway.passport import Passport, Quantity
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Axles, Brake, BrakingCurves, Configuration, ParameterSet, Train
from trainlog.railway.trajectory import Trajectory

__all__ = [
    "AxleGeometry",
    "Axles",
    "Brake",
    "BrakingCurves",
    "Configuration",
    "CreepCurve",
    "CurvatureProfile",
    "Edge",
    "EffortCurve",
    "Geometry",
    "Journey",
    "Leg",
    "Line",
    "LineReference",
    "Network",
    "Node",
    "ParameterSet",
    "Passport",
    "Quantity",
    "Route",
    "RunningResistance",
    "Station",
    "StepProfile",
    "Survey",
    "TimingPoint",
    "TrackConditionMap",
    "Train",
    "Trajectory",
    "Tunnel",
]
