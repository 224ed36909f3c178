"""What is computed from trips and maps.

Examples
--------
>>> import analysis
>>> result = analysis.slip("sample_logs/stopping.mcap")
>>> len(result.events) > 0
True
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainlog.extras import names_on_first_use

if TYPE_CHECKING:
    from analysis.adhesion.characteristic import (
        fit_adhesion_characteristic as fit_adhesion_characteristic,
    )
    from analysis.adhesion.condition_map import (
        adhesion_map as adhesion_map,
        update_map as update_map,
    )
    from analysis.adhesion.condition_table import bins_table as bins_table
    from analysis.adhesion.export import export_map as export_map
    from analysis.adhesion.map_difference import (
        map_difference as map_difference,
        map_history as map_history,
    )
    from analysis.adhesion.map_state import map_state as map_state
    from analysis.adhesion.slip import slip as slip
    from analysis.comparison.calculated import calculate as calculate
    from analysis.comparison.compare import compare as compare
    from analysis.comparison.groups import compare_groups as compare_groups
    from analysis.control.follow import (
        Follower as Follower,
        following_scenarios as following_scenarios,
    )
    from analysis.control.traction import (
        CooperativeTraction as CooperativeTraction,
        ReadhesionControl as ReadhesionControl,
        with_traction as with_traction,
    )
    from analysis.estimates import with_estimates as with_estimates
    from analysis.fleet.analyses import FleetAnalysis as FleetAnalysis
    from analysis.fleet.update import (
        UpdateOptions as UpdateOptions,
        fleet_status as fleet_status,
        update_fleet as update_fleet,
    )
    from analysis.geometry.centre_line import geometry_of as geometry_of, line_of as line_of
    from analysis.reports.build import ReportOptions as ReportOptions, write_report as write_report
    from analysis.reports.summary import report as report
    from analysis.resistance import (
        TripRefusedError as TripRefusedError,
        combine as combine,
        fit_trip as fit_trip,
        parameter_set as parameter_set,
    )
    from analysis.resistance.coast_down import (
        coast_down as coast_down,
        coast_down_without_gradient as coast_down_without_gradient,
    )
    from analysis.resistance.logs import fit as fit
    from analysis.resistance.passport import passport as passport
    from analysis.trajectory.advice import journey_advice as journey_advice
    from analysis.trajectory.instructions import phases_of as phases_of
    from analysis.trajectory.journey import optimise_journey as optimise_journey
    from analysis.trajectory.optimiser import (
        energy_against_time as energy_against_time,
        optimise as optimise,
    )
    from analysis.trajectory.problem import (
        OptimiserOptions as OptimiserOptions,
        TrajectoryProblem as TrajectoryProblem,
    )
    from analysis.verification.scoring import (
        score_forecast as score_forecast,
        score_map as score_map,
        score_rolling as score_rolling,
    )
    from analysis.view import TripView as TripView, view_of as view_of, views_of as views_of

if not TYPE_CHECKING:  # type checkers refuse names that are not listed above
    __all__, __getattr__, __dir__ = names_on_first_use(__name__, __file__)
