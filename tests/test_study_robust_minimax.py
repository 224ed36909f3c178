"""The study of Cunillera et al. (2022): its equations, its five phases, the use of robustness."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from analysis.studies import cunillera_2022 as study
from analysis.trajectory.discretisation import discretise
from analysis.trajectory.instructions import Phase
from trainlog.railway import Trajectory

CELLS = 160
"""A third of the study's, which the long tests have."""
LEVEL, DOWNHILL, CHOSEN = study.level(), study.downhill(), study.configurations()


@cache
def answer(name: str) -> Trajectory:
    """The trajectory of one of the study's questions."""
    return study.solved(*study.questions(LEVEL, DOWNHILL, CHOSEN)[name], cells=CELLS)


def per_mass(found: Trajectory) -> float:
    return float(found.certificate["energy"]) / CHOSEN[0].inertia


def test_energy_is_the_same_for_all_and_every_constraint_holds_as_printed():
    """Eqs. (2) to (4) integrated in v and t, where the optimiser has v²/2 alone."""
    found = answer("level-common")
    driven = study.driven(LEVEL, found, CHOSEN)
    assert np.ptp(driven.energy) == 0.0
    assert driven.energy[0] == pytest.approx(per_mass(found), rel=1e-9)
    assert driven.speeds == pytest.approx(found.speeds, abs=1e-6)
    assert driven.times == pytest.approx(found.times, abs=1e-3)
    problem = discretise(LEVEL.run(CHOSEN, "common"), found.positions)
    assert max(study.as_printed(problem, found, driven).values()) <= 1e-4


def test_all_five_phases_occur_and_the_sum_of_the_costates_gives_them():
    seen = set()
    for name in ("level-common", "downhill-common", "level-recourse", "downhill-recourse"):
        seen |= study.phase_durations(answer(name)).keys()
        assert min(answer(name).certificate["agreement"].values()) >= 0.99
        assert study.phases_agree(answer(name)) >= 0.95
    assert seen == set(Phase)
    assert Phase.PARTIAL_BRAKING not in study.phase_durations(answer("level-common"))


@pytest.mark.parametrize("name", ["level-nominal", "level-common", "level-recourse"])
def test_the_multiplier_of_the_time_is_that_of_steady_cruising(name):
    cruise = study.cruise(answer(name))
    assert cruise.price == pytest.approx(cruise.analytic, rel=5e-5)
    if name == "level-nominal":
        resistance = study.TRAIN.resistance
        slope = resistance.r1 + 2.0 * resistance.r2 * cruise.speed
        alone = cruise.speed**2 * slope / CHOSEN[1].inertia
        assert cruise.price == pytest.approx(alone, rel=1e-3)


def test_robustness_costs_little_and_saves_the_timetable():
    alone = {each.name: per_mass(answer(f"level-{each.name}")) for each in CHOSEN}
    common, recourse = (per_mass(answer(f"level-{name}")) for name in ("common", "recourse"))
    assert alone["easy"] < alone["nominal"] < alone["hard"] <= recourse * (1.0 + 1e-6)
    assert recourse < common, "one brake for all is less than a brake each"
    assert common < 1.03 * alone["nominal"]
    nominal = answer("level-nominal")
    for braking in ("common", "recourse"):
        late = study.driven(LEVEL, nominal, CHOSEN, braking=braking).times[:, -1] - 1541.0
        assert late[0] < -10.0
        assert abs(late[1]) < 0.1
        assert late[2] > 10.0
    ends = study.driven(LEVEL, nominal, CHOSEN).speeds[:, -1]
    assert ends[0] > LEVEL.final_speed + 1.0
    robust = study.driven(LEVEL, answer("level-common"), CHOSEN)
    assert robust.times[:, -1].max() <= 1541.0 + 1e-3
    assert robust.speeds[:, -1].max() <= LEVEL.final_speed + 1e-5
