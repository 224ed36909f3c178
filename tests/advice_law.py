"""The law of advice: what it names the plan does, and its speeds follow one another."""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np

from analysis.trajectory.advice import AdviceRow
from analysis.trajectory.instructions import HELD
from trainlog.railway import Trajectory
from trainlog.spans import runs_of

KMH = 3.6
ROUNDING = 0.51 / KMH
UNSAID = 6.0 / KMH
"""Most that traction which no row names may add to the speed at once [m/s]."""

IDLE = 45.0
"""Longest that a plan may coast within a row that holds a speed [s]: two rows more cost as much as
half a minute of it, and the speeds that they would state some more."""


APPLIED, LEFT = 1.0 / KMH, 2.5 / KMH
"""What a brake application takes off a speed that is to be named, and what of it may lie in rows
beside, where another configuration drives [m/s]."""


def unnamed_brakes(plan: Trajectory, changes: list[AdviceRow], ends: list[float]) -> list[str]:
    """Brake applications of any configuration that no row names, nor a speed to hold."""
    found, places = list[str](), plan.positions
    named = np.zeros(places.size - 1, dtype=bool)
    for row, end in zip(changes, ends, strict=True):
        if "brake" in row.words or row.words.startswith("hold"):
            named |= (plan.positions[:-1] >= row.position - 1e-6) & (
                plan.positions[1:] <= end + 1e-6
            )
    for number, letters in enumerate(plan.certificate["phases"]):
        lost = plan.braking_effort[number] / plan.configurations[number].inertia
        lost = lost * np.diff(plan.times[number])
        for start, past in runs_of(np.isin(list(letters), ["H", "B"])):
            whole = lost[start:past].sum()
            left = whole - lost[start:past][named[start:past]].sum()
            own = number == plan.latest
            if whole > APPLIED and left > (APPLIED if own else LEFT):
                at = f"{places[start]:.0f} m"
                found.append(f"{KMH * left:.1f} km/h by braking at {at} are not named")
    return found


def breaches(plan: Trajectory, rows: list[AdviceRow]) -> list[str]:
    """What the rows of one section's advice state that its plan does not contain."""
    changes = [row for row in rows if row.event == "changes"]
    letters = np.array([list(each) for each in plan.certificate["phases"]])
    brakes = np.isin(letters, ["H", "B"]).any(axis=0)
    drives = np.isin(letters, ["T", "P"]).any(axis=0)
    own, places = plan.latest, plan.positions
    coasts = ~drives & (letters[own] == "C")
    ends = [*(row.position for row in changes[1:]), float(places[-1])]
    found = []
    for row, end in zip(changes, ends, strict=True):
        cells = (places[:-1] >= row.position - 1e-6) & (places[1:] <= end + 1e-6)
        speeds = plan.speeds[own][(places >= row.position - 1e-6) & (places <= end + 1e-6)]
        begin, last, words = speeds[0], speeds[-1], row.words
        target = re.match(
            r"(?:hold|brake[^;]* to|full traction to|partial traction to) (\d+)", words
        )
        speed = float(target[1]) / KMH if target else None
        if "brake" in words and not brakes[cells].all():
            found.append(f"{words}: nobody brakes on {(~brakes[cells]).sum()} cells")
        if "traction" in words and not drives[cells].all():
            found.append(f"{words}: nobody drives on {(~drives[cells]).sum()} cells")
        if words.startswith("hold") and np.abs(speeds - speed).max() > HELD + ROUNDING:
            found.append(f"{words}: {KMH * speeds.min():.0f} to {KMH * speeds.max():.0f} km/h")
        if words.startswith("hold"):
            spans = runs_of(coasts & cells)
            lasts = max(
                (plan.times[own, past] - plan.times[own, at] for at, past in spans), default=0
            )
            if lasts > IDLE:
                found.append(f"{words}: nobody drives for {lasts:.0f} s")
        if not words.startswith("hold") and speed is not None:
            slower = words.startswith("brake, if faster") and last < speed
            if abs(last - speed) > HELD + ROUNDING and not slower:
                found.append(f"{words}: ends at {KMH * last:.0f} km/h")
        if words.startswith(("coast", "brake")):
            pull = plan.tractive_effort[cells] / plan.configurations[own].inertia
            pull *= np.diff(plan.times[own])[cells]
            runs = runs_of(np.isin(letters[own, cells], ["T", "P"]))
            gains = [
                min(pull[start:past].sum(), speeds[start : past + 1].max() - speeds[start])
                for start, past in runs
            ]
            gained = max(gains, default=0.0)
            if gained > UNSAID:
                found.append(f"{words}: {KMH * gained:.0f} km/h by traction are left out")
        if "to a stand" in words and last > ROUNDING:
            found.append(f"{words}: ends at {KMH * last:.0f} km/h")
        if abs(begin - row.speed) > 1e-6 or abs(last - row.instruction.until) > 1e-6:
            found.append(f"{words}: other speeds at its ends")
    found += unnamed_brakes(plan, changes, ends)
    for row in rows:
        if row.permitted is not None and row.stated > row.permitted + 1e-6:
            found.append(
                f"{row.words}: {KMH * row.stated:.1f} km/h where {KMH * row.permitted:.1f} are due"
            )
    idle = coasts & ~brakes
    for before, after in pairwise(changes):
        if before.instruction.until != after.speed:
            found.append(f"{after.words} begins at another speed than the row before ends at")
        beside = int(np.searchsorted(places, after.position - 1e-6))
        for row, cell, other in ((before, beside - 1, after), (after, beside, before)):
            if row.words.startswith("hold") and other.words.startswith("coast") and idle[cell]:
                found.append(f"{row.words}: nobody drives beside {other.words}")
        if before.words.split(";")[0] == after.words.split(";")[0]:
            found.append(f"{after.words}: twice")
        kinds = [
            re.match(r"(\w+)(?: gently|, if faster)?", each.words)[1] for each in (before, after)
        ]
        if kinds[0] == kinds[1] and kinds[0] != "hold":
            found.append(f"{before.words} and {after.words} are of one kind")
    return found
