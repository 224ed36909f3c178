"""The file of a trajectory, ``"trainlog/trajectory"``; docs/formats.md describes its keys."""

from __future__ import annotations

from pathlib import Path

from trainlog.formats.declared import read_thing, write_thing
from trainlog.railway.trajectory import Trajectory


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory file; errors as `read_thing`.

    Examples
    --------
    >>> read_trajectory("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return read_thing(Trajectory, path)


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
    write_thing(trajectory, path, Trajectory)
