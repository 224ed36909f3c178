"""Recursive estimators: one sample in, one estimate out; they know arrays, not logs or files."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimators.adhesion import AdhesionObserver
    from estimators.interface import Estimator
    from estimators.rls import RecursiveLeastSquares
    from estimators.running_resistance import RunningResistanceFilter
    from estimators.slip import SlipDetector
    from estimators.train_state import TrainStateFilter

    # That each of them has the interface is a matter of types, not of running.
    _ESTIMATORS: tuple[type[Estimator], ...] = (
        AdhesionObserver,
        RecursiveLeastSquares,
        RunningResistanceFilter,
        SlipDetector,
        TrainStateFilter,
    )
