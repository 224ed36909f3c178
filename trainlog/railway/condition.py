"""The track-condition map: maximum adhesion along a line, by rail condition.

A map is a set of layers (``"dry"``, ``"wet"`` ...). Each layer has one row a bin of the line: the
estimate, its uncertainty, whether it was observed at all, and the statistics it was made from,
which add up in any order so that trips can be processed apart and merged.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from trainlog.display import as_html, as_text, counted, picture, span
from trainlog.errors import InputError

FloatArray = NDArray[np.float64]

BIN_LENGTH = 25.0
"""Length of a bin [m]."""


@dataclass(frozen=True, eq=False)
class ConditionLayer:
    """Maximum adhesion in one rail condition.

    Attributes
    ----------
    log_mean, log_std : (n,) array
        Natural logarithm of the maximum adhesion and its standard deviation.
    observed : (n,) bool array
        Whether evidence in or near the bin determines the estimate. Where it is false the
        estimate is only the prior: it must not be shown as data.
    events : (n,) array
        Onsets of slip measured in the bin.
    weight, weighted_log : (n,) array
        Sum of the weights of the measured onsets, and of weight times log adhesion.
    censored : (n, k) array
        Histogram over `levels` of "the maximum is at least this": adhesion that was used without
        slip.
    common : (n,) array, optional
        Sum over the trips of the squared weight times the variance of the error that all onsets
        of a trip share, from a load and a gain of the efforts that are not known; None: none did.
    """

    log_mean: FloatArray
    log_std: FloatArray
    observed: NDArray[np.bool_]
    events: FloatArray
    weight: FloatArray
    weighted_log: FloatArray
    censored: FloatArray
    common: FloatArray | None = None

    @property
    def maximum_adhesion(self) -> FloatArray:
        """Estimate of the maximum adhesion a bin, NaN where nothing was observed."""
        estimate: FloatArray = np.exp(self.log_mean)
        return np.asarray(np.where(self.observed, estimate, np.nan), dtype=np.float64)


@dataclass(frozen=True, repr=False)
class TrackConditionMap:
    """Maximum adhesion along a line.

    Attributes
    ----------
    line : str
        Name of the line.
    length : float [m]
    bin_length : float [m]
    levels : (k,) array
        Adhesion levels of the censoring histograms.
    layers : dict of str to ConditionLayer
    trips : tuple of dict
        Provenance: name and SHA-256 of every log counted in, and its layer.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map.json")
    >>> track.bins, sorted(track.layers)
    (1183, ['dry', 'wet'])
    >>> track.lower_bound("wet", [5_000.0]).shape
    (1,)
    """

    line: str
    length: float
    bin_length: float
    levels: FloatArray
    layers: dict[str, ConditionLayer]
    trips: tuple[dict[str, Any], ...] = ()
    settings: dict[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        return as_text(self._title, self._summary())

    def _repr_html_(self) -> str:
        layers = {name: each.maximum_adhesion.round(3) for name, each in self.layers.items()}
        return as_html(self._title, self._summary(), picture(self.centres, layers))

    @property
    def _title(self) -> str:
        return (
            f"Track-condition map of line '{self.line}', {counted(self.bins, 'bin')} of"
            f" {self.bin_length:g} m, from {counted(len(self.trips), 'trip')}"
        )

    def _summary(self) -> dict[str, str]:
        rows = {}
        for name, layer in self.layers.items():
            known = layer.maximum_adhesion[layer.observed]
            slips = counted(int(layer.events.sum()), "slip event")
            rows[name] = f"{counted(known.size, 'bin')} observed, {slips}" + (
                f", maximum adhesion {span(known, 1.0, 3)}" if known.size else ""
            )
        lacking = sum(bool(trip.get("notes")) for trip in self.trips)
        if lacking:
            rows["recorders"] = f"of {counted(lacking, 'trip')} lack something of what is needed"
        return rows or {"layers": "none"}

    @property
    def bins(self) -> int:
        """Number of bins."""
        return int(np.ceil(self.length / self.bin_length))

    @property
    def centres(self) -> FloatArray:
        """Position of each bin's centre [m]."""
        return np.asarray((np.arange(self.bins) + 0.5) * self.bin_length, dtype=np.float64)

    def layer(self, name: str) -> ConditionLayer:
        """The layer called `name`.

        Raises
        ------
        InputError
            If the map has no such layer.
        """
        try:
            return self.layers[name]
        except KeyError:
            raise InputError(
                f"map of line '{self.line}' has no layer '{name}'",
                remedy=f"layers present: {', '.join(self.layers) or 'none'}",
            ) from None

    def bin_of(self, position: ArrayLike) -> NDArray[np.int64]:
        """Index of the bin that holds each position [m]; ends are extended."""
        index = np.floor(np.asarray(position, dtype=np.float64) / self.bin_length)
        return np.clip(index, 0, self.bins - 1).astype(np.int64)

    def lower_bound(self, layer: str, position: ArrayLike, sigmas: float = 2.0) -> FloatArray:
        """Cautious maximum adhesion at each position: the estimate less `sigmas` deviations.

        Infinite where the layer was not observed: the map says nothing there.

        Examples
        --------
        >>> from trainlog.formats.condition import read_map
        >>> track = read_map("sample_logs/CH_StGallen_Wil.map.json")
        >>> seen = track.centres[track.layer("wet").observed][:2]
        >>> track.lower_bound("wet", seen).round(3).tolist()
        [0.127, 0.126]
        """
        chosen = self.layer(layer)
        index = self.bin_of(position)
        cautious = np.exp(chosen.log_mean[index] - sigmas * chosen.log_std[index])
        return np.asarray(np.where(chosen.observed[index], cautious, np.inf))

    def likely(self, layer: str, position: ArrayLike, sigmas: float = 2.0) -> FloatArray:
        """Cautious maximum adhesion at each position, also where the layer was not observed.

        There it is what the layer's own places and its neighbours make likely, with the larger
        deviation of that: good enough to drive with care, not to be shown as data.

        It is an expectation, right for a driver or controller that sees the train slip and eases
        off, and it never says that nothing limits. What a plan rests on must not be guessed:
        `analysis.adhesion.demonstrated` takes there only what a trip bore without slip, or an
        assumption that is called one.
        """
        chosen = self.layer(layer)
        index = self.bin_of(position)
        return np.asarray(np.exp(chosen.log_mean[index] - sigmas * chosen.log_std[index]))
