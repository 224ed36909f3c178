"""Recursive estimators, filters and smoothers; they work on arrays, not on logs or files.

Examples
--------
>>> import estimators
>>> detector = estimators.SlipDetector(axles=1, slip_std=0.05)
>>> detector.update([[2.0], [2.1]]).tolist()
[[False], [True]]
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainlog.extras import names_on_first_use

if TYPE_CHECKING:
    from estimators.adhesion import (
        AdhesionObserver as AdhesionObserver,
        SlipDetector as SlipDetector,
        smoothed_force as smoothed_force,
        train_speed as train_speed,
    )
    from estimators.creep_curve import estimate_creep_curve as estimate_creep_curve
    from estimators.linear_gaussian import (
        LinearGaussian as LinearGaussian,
        random_walk_slope as random_walk_slope,
    )
    from estimators.motion import (
        LastingError as LastingError,
        OdometryFilter as OdometryFilter,
        smooth_motion as smooth_motion,
    )
    from estimators.regression import (
        RecursiveLeastSquares as RecursiveLeastSquares,
        edges_crossed as edges_crossed,
        periods_elapsed as periods_elapsed,
        record_with_resets as record_with_resets,
    )

if not TYPE_CHECKING:  # type checkers refuse names that are not listed above
    __all__, __getattr__, __dir__ = names_on_first_use(__name__, __file__)
