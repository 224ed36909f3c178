"""The trajectory format, ``"trainlog/trajectory"``; docs/formats.md describes its keys."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.files import check_written, plain, read_bytes, write_bytes
from trainlog.formats.parameters import ConfigurationPart, Details
from trainlog.formats.schema import Array, File, Quantity, built
from trainlog.railway.trajectory import Trajectory

_ROUNDING = 1e-6
"""What a solver's zero may fall short of zero [N], [m/s]."""


class _TrajectoryFile(File):
    FORMAT: ClassVar[str] = "trainlog/trajectory"

    line: str
    train: str
    direction: Literal["forward", "reverse"] = "forward"
    running_time: Annotated[float, Quantity("s", "s")]
    configurations: list[ConfigurationPart] = Field(min_length=1)
    positions: Annotated[FloatArray, Array("m")]
    tractive_effort: Annotated[FloatArray, Array("N")]
    tractive_effort_fall: Annotated[FloatArray, Array("N")] = Field(
        default_factory=lambda: np.zeros(0)
    )
    braking_effort: Annotated[FloatArray, Array("N", dimensions=2)]
    speeds: Annotated[FloatArray, Array("m/s", dimensions=2)]
    times: Annotated[FloatArray, Array("s", dimensions=2)]
    certificate: Details = Field(default_factory=dict)
    provenance: Details = Field(default_factory=dict)

    def trajectory(self) -> Trajectory:
        """The trajectory that the file describes."""
        self.check()
        configurations = tuple(part.configuration() for part in self.configurations)
        return Trajectory(**dict(self) | {"configurations": configurations})

    def check(self) -> None:
        """Refuse what no train can do."""
        falling = np.flatnonzero(np.diff(self.positions) <= 0.0)
        if falling.size or self.positions.size < 2:
            row = int(falling[0]) + 1 if falling.size else 0
            raise InputError(
                "positions must increase",
                place=f"positions.values[{row}]",
                remedy="give at least two",
            )
        for name in ("tractive_effort", "braking_effort", "speeds"):
            if np.any(getattr(self, name) < -_ROUNDING):
                raise InputError(
                    "must not be negative", place=f"{name}.values", remedy="correct it"
                )
        fall = self.tractive_effort_fall
        if fall.size == self.tractive_effort.size:
            steep = np.flatnonzero(0.5 * np.abs(fall) > self.tractive_effort + _ROUNDING)
            if steep.size:
                raise InputError(
                    "the tractive effort must not fall below zero within a cell",
                    place=f"tractive_effort_fall.values[{steep[0]}]",
                    remedy="correct it",
                )

    @staticmethod
    def of(trajectory: Trajectory) -> _TrajectoryFile:
        """The file that describes a trajectory."""
        file = _TrajectoryFile.holding(
            trajectory,
            configurations=[ConfigurationPart.of(item) for item in trajectory.configurations],
            certificate=plain(trajectory.certificate, "certificate"),
            provenance=plain(trajectory.provenance, "provenance"),
        )
        file.check()
        return file


def trajectory_from_bytes(data: bytes, *, file: str | Path = "trajectory.json") -> Trajectory:
    """The trajectory in the bytes of a trajectory file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a trajectory file, naming the place and the remedy.

    Examples
    --------
    >>> trajectory_from_bytes(b'{"format": "trainlog/line"}')  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: trajectory.json, format: is a file of format 'trainlog/line'...
    """
    return built(_TrajectoryFile.from_bytes(data, file).trajectory, file)


def trajectory_to_bytes(trajectory: Trajectory) -> bytes:
    """The bytes of the file: doubles exact, the same trajectory gives the same bytes."""
    return _TrajectoryFile.of(trajectory).to_bytes()


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory file; errors as `trajectory_from_bytes`, and if it cannot be read.

    Examples
    --------
    >>> read_trajectory("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return trajectory_from_bytes(read_bytes(path), file=path)


def write_trajectory(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory file, whole or not at all.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> nominal = trainlog.Configuration.of(train)
    >>> trajectory = Trajectory(
    ...     "line", train.name, np.array([0.0, 500.0, 1000.0]), (nominal,),
    ...     np.array([[0.0, 20.0, 0.0]]), np.array([[0.0, 50.0, 100.0]]),
    ...     np.array([53e3, 0.0]), np.array([[0.0, 53e3]]), 100.0,
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_trajectory(trajectory, f"{folder}/trajectory.json")
    ...     again = read_trajectory(f"{folder}/trajectory.json")
    >>> again.running_time
    100.0
    """
    check_written(trajectory, Trajectory)
    write_bytes(path, trajectory_to_bytes(trajectory))
