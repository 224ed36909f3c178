"""Simulated trips: a train on a line, who drives it, what its sensors record.

``draw_scenarios`` draws trips of a train over a line, ``simulate`` makes the log of one. A
controller drives when it implements the protocol `Driver`.
"""

from trainlog.simulation.consist import ConsistPlant, ConsistState, Variation
from trainlog.simulation.drivers import (
    Demand,
    Driver,
    Habits,
    Observation,
    Stop,
    TimetableDriver,
    check_stops,
    plan,
)
from trainlog.simulation.fleet import Fleet, FleetScenario, as_recorded, draw_fleet
from trainlog.simulation.fleet_logs import FleetLogs, write_fleet, write_trip
from trainlog.simulation.network import draw_network
from trainlog.simulation.plant import Drive, Plant, PlantState
from trainlog.simulation.rail import Change, Rail, RailState
from trainlog.simulation.recording import Run, drive, recorded, simulate
from trainlog.simulation.scenario import (
    Locator,
    Scenario,
    draw_days,
    draw_scenarios,
    trajectory_scenarios,
)
from trainlog.simulation.sensors import Instruments, Reading, Sensors
from trainlog.simulation.traction import (
    DriveReading,
    DriveSensors,
    TractionControl,
    TractionLoop,
)
from trainlog.simulation.vehicles import Fault, FleetTrain

__all__ = [
    "Change",
    "ConsistPlant",
    "ConsistState",
    "Demand",
    "Drive",
    "DriveReading",
    "DriveSensors",
    "Driver",
    "Fault",
    "Fleet",
    "FleetLogs",
    "FleetScenario",
    "FleetTrain",
    "Habits",
    "Instruments",
    "Locator",
    "Observation",
    "Plant",
    "PlantState",
    "Rail",
    "RailState",
    "Reading",
    "Run",
    "Scenario",
    "Sensors",
    "Stop",
    "TimetableDriver",
    "TractionControl",
    "TractionLoop",
    "Variation",
    "as_recorded",
    "check_stops",
    "draw_days",
    "draw_fleet",
    "draw_network",
    "draw_scenarios",
    "drive",
    "plan",
    "recorded",
    "simulate",
    "trajectory_scenarios",
    "write_fleet",
    "write_trip",
]
