"""What can be drawn: a result names the function that makes its charts, and `plot` draws them."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

from trainlog.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Plotted:
    """A result of which there are charts.

    Charts are described in the package `analysis`, which stands above the data that they show;
    a class therefore names the function that makes them. It is imported when it is first called.

    Attributes
    ----------
    charts_by : str
        As ``"module:function"``; the function takes the result and options of its own, and returns
        charts (`analysis.charts.Chart`). Empty where there is no picture.
    """

    __slots__ = ()

    charts_by: ClassVar[str] = ""

    def charts(self, **options: Any) -> Sequence[Any]:
        """The charts of this result; further `options` as of the function `charts_by`.

        Raises
        ------
        InputError
            If there is no picture of such a result.
        """
        if not self.charts_by:
            raise InputError(
                f"{type(self).__name__} has no plot", remedy="print it, or use its attributes"
            )
        module, _, name = self.charts_by.partition(":")
        charts: Sequence[Any] = getattr(import_module(module), name)(self, **options)
        return charts

    def plot(self, **options: Any) -> Figure:
        """Draw this result.

        Parameters
        ----------
        **options
            As of the function `charts_by`.

        Returns
        -------
        matplotlib.figure.Figure
            A notebook shows it; ``figure.savefig("picture.png")`` writes it.
        """
        figure: Figure = import_module("analysis.charts").figure_of(self.charts(**options))
        return figure
