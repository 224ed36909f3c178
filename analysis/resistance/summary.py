"""What is kept of a trip's fit: a row of `trainlog.formats.summaries`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from analysis.resistance.fit import TripFit
from analysis.resistance.refusal import TripRefusedError
from trainlog import __version__
from trainlog.formats.summaries import COLUMNS, COVARIANCE, PARAMETERS, SURVEY, ordered

SOFTWARE = f"trainlog {__version__}"


def summarised(
    fits: Sequence[TripFit],
    refused: Mapping[str, TripRefusedError] | None = None,
    *,
    trains: Mapping[str, str] | None = None,
    digests: Mapping[str, str] | None = None,
) -> pd.DataFrame:
    """Summaries of trips that were fitted, and of those that were refused.

    Parameters
    ----------
    fits : sequence of TripFit
    refused : mapping of trip to TripRefusedError, optional
    trains : mapping of trip to name of the train, optional
        Of the refused trips.
    digests : mapping of trip to SHA-256, optional
        Of their logs; empty where there is none.

    Returns
    -------
    DataFrame
        With the columns of `trainlog.formats.summaries.COLUMNS`, in the order of trip.
    """
    known = digests or {}
    rows = [_row(fit) for fit in fits]
    rows += [
        {
            "trip": trip,
            "train": (trains or {}).get(trip, ""),
            "refused": error.reason,
            "message": str(error),
        }
        for trip, error in (refused or {}).items()
    ]
    for row in rows:
        row |= {"sha256": known.get(str(row["trip"]), ""), "software": SOFTWARE}
    empty = {"text": "", "count": 0, "number": np.nan}
    columns = {
        column.name: pd.Series(
            [row.get(column.name, empty[column.kind]) for row in rows],
            dtype={"text": object, "count": np.int64, "number": np.float64}[column.kind],
        )
        for column in COLUMNS
    }
    return ordered(pd.DataFrame(columns))


def _row(fit: TripFit) -> dict[str, object]:
    upper = fit.covariance[np.triu_indices(4)].tolist()
    survey = fit.survey[:3, :3][np.triu_indices(3)].tolist()
    number: dict[str, float | None] = {
        "freedom": fit.freedom,
        "rotating_mass": fit.rotating_mass,
        "train_power": fit.train_power,
        "asked_lowest": fit.asked[0],
        "asked_highest": fit.asked[1],
        "speed_lowest": fit.speed_range[0],
        "speed_highest": fit.speed_range[1],
        "condition": fit.condition,
        "windows": fit.windows["used"],
        "outliers": fit.windows["outlier"],
        "delay": fit.nuisance["delay"],
        "brake_scale": fit.nuisance["brake_scale"],
        "cluster_factor": fit.cluster_factor,
        "residual_std": fit.residual_std,
        "residual_correlation": fit.residual_correlation,
        "speed_scale": fit.scale.factor,
        "speed_scale_std": fit.scale.std,
    }
    if fit.max_power is not None:
        number |= {"max_power": fit.max_power, "max_power_std": fit.max_power_std}
    return {
        "trip": fit.trip,
        "train": fit.train,
        "refused": "",
        "message": "",
        "speed_scale_source": fit.scale.source,
        "gradients": fit.gradients,
        **dict(zip(PARAMETERS, [*fit.beta.tolist(), fit.mass], strict=True)),
        **dict(zip(COVARIANCE, upper, strict=True)),
        **dict(zip(SURVEY, survey, strict=True)),
        **number,
        **{f"noise_{cause}": size for cause, size in fit.noise.items()},
        **{f"masked_{reason}": time for reason, time in fit.masked.items()},
    }
