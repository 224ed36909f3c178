"""Results of costly functions, made once of the same arguments by all workers of a run."""

import hashlib
import importlib
import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

COSTLY = (
    "trainlog.simulation.drive",
    "trainlog.simulation.recording.drive",
    "trainlog.condition._estimated",
    "estimators.creep_curve._smoothed",
    "analysis.adhesion.slip._slip",
    "analysis.resistance.passport._delay_and_ratio",
    "analysis.resistance.fit.fit_windows",
    "analysis.trajectory.optimiser._optimised",
)  # functions whose results depend on their arguments and the constants of their modules alone


def place_of(dotted: str) -> tuple[Any, str]:
    """The module of a function, and its name there."""
    module, _, name = dotted.rpartition(".")
    return importlib.import_module(module), name


class Remembered:
    """Results by what they were made of, kept in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def of(self, dotted: str) -> Callable[..., Any]:
        """The function, each result of which is made once; what it refuses is refused anew."""
        place, name = place_of(dotted)
        made = getattr(place, name)
        module = importlib.import_module(made.__module__)

        def known(*given: Any, **named: Any) -> Any:
            try:
                kept = self.folder / f"{name}-{_digest(module, (*given, *named.items()))}"
            except (AttributeError, TypeError, pickle.PicklingError):  # as of a function of a test
                return made(*given, **named)
            try:
                return pickle.loads(kept.read_bytes())
            except FileNotFoundError:
                found = made(*given, **named)
            part = kept.with_name(f"{kept.name}.{os.getpid()}")
            part.write_bytes(pickle.dumps(found))
            part.replace(kept)
            return found

        return known


def _digest(module: Any, given: tuple[Any, ...]) -> str:
    """Of the arguments, and of numbers of the module, which a test may change."""
    from analysis.view import TripView
    from estimators.condition_field import ROUNDS
    from trainlog.railway import TrackConditionMap

    first, *others = given
    if isinstance(first, TripView):  # of the trip, wherever its log lies and whatever was made
        first = (first.trip, first.number, first.count)
    if isinstance(first, TrackConditionMap):  # of the evidence of the layer that is named
        evidence = first.layers[others[0]].evidence
        first, others = replace(first, layers={}, trips=()), [*others, evidence]
    known = vars(module).items()
    numbers = {n: x for n, x in known if n.isupper() and isinstance(x, int | float)}
    return hashlib.sha256(pickle.dumps((first, others, numbers, ROUNDS))).hexdigest()
