"""Simulated trips: a train on a line, who drives it, what its sensors record.

``draw_scenarios`` draws trips of a train over a line, ``simulate`` makes the log of one. A
controller drives when it implements the protocol `Driver`.
"""

from trainlog.simulation.consist import (
    ConsistPlant as ConsistPlant,
    ConsistState as ConsistState,
    Variation as Variation,
)
from trainlog.simulation.drivers import (
    Demand as Demand,
    Driver as Driver,
    Habits as Habits,
    Observation as Observation,
    Stop as Stop,
    TimetableDriver as TimetableDriver,
    check_stops as check_stops,
    plan as plan,
)
from trainlog.simulation.fleet import (
    Fleet as Fleet,
    FleetLogs as FleetLogs,
    FleetScenario as FleetScenario,
    as_recorded as as_recorded,
    draw_fleet as draw_fleet,
    write_fleet as write_fleet,
    write_trip as write_trip,
)
from trainlog.simulation.network import draw_network as draw_network
from trainlog.simulation.plant import Drive as Drive, Plant as Plant, PlantState as PlantState
from trainlog.simulation.rail import Change as Change, Rail as Rail, RailState as RailState
from trainlog.simulation.recording import (
    Run as Run,
    drive as drive,
    recorded as recorded,
    simulate as simulate,
)
from trainlog.simulation.scenario import (
    Locator as Locator,
    Scenario as Scenario,
    draw_days as draw_days,
    draw_scenarios as draw_scenarios,
    trajectory_scenarios as trajectory_scenarios,
)
from trainlog.simulation.sensors import (
    Instruments as Instruments,
    Reading as Reading,
    Sensors as Sensors,
)
from trainlog.simulation.traction import (
    DriveReading as DriveReading,
    DriveSensors as DriveSensors,
    TractionControl as TractionControl,
    TractionLoop as TractionLoop,
)
from trainlog.simulation.vehicles import Fault as Fault, FleetTrain as FleetTrain
