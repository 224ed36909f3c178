"""What is reported of a trajectory: which energy, where, and how sure."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cvxpy as cp
import pytest
from trajectory_cases import FLIRT, hilly_line, observed, optimised

from analysis.trajectory import active_set, convex, optimiser
from trainlog.cli.main import run
from trainlog.display import at_most
from trainlog.errors import InfeasibleError, InputError
from trainlog.formats.samples import sample

pytestmark = pytest.mark.usefixtures("unrenewed")


def test_a_solver_that_breaks_off_reports_no_settings_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise cp.SolverError("Try another solver, or solve with verbose=True")

    monkeypatch.setattr(cp.Problem, "solve", broken)
    monkeypatch.setattr(convex, "_by_piqp", lambda *_, **__: None)
    monkeypatch.setattr(active_set, "descend", lambda *_: None)
    monkeypatch.setattr(optimiser, "_paced", lambda *_: None)
    with pytest.raises(InfeasibleError, match="beyond the solver's arithmetic") as refusal:
        optimised(hilly_line(), FLIRT, observed(FLIRT, 1.0), reserve=0.1, cells=40)
    assert "verbose" not in str(refusal.value)


def test_the_time_that_a_refusal_names_is_accepted() -> None:
    asked = (hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.1))
    least = max(optimised(*asked, reserve=0.0, cells=40).certificate["least_time"])
    named = set()
    for share in (0.5, 1.0 + 1e-7):
        with pytest.raises(InfeasibleError) as refusal:
            optimised(*asked, running_time=share * least, cells=40)
        named.add(refusal.value.remedy or "")
    (words,) = named
    time = re.fullmatch(r"allow at least (\d+) s", words)
    assert time
    found = optimised(*asked, running_time=float(time[1]), cells=40)
    assert found.certificate["audit"]["lateness"] <= 1e-4


def test_a_set_that_cannot_be_planned_for_comes_with_a_remedy() -> None:
    one = observed(FLIRT, 1.0)
    with pytest.raises(InputError, match="no parameter configuration given; give a set"):
        optimised(hilly_line(), FLIRT, [])
    with pytest.raises(InputError, match="are called 'x1'; give each a name"):
        optimised(hilly_line(), FLIRT, [*one, *one])


def test_a_bound_is_rounded_up() -> None:
    assert at_most(0.000141, 2) == "0.02%"
    assert at_most(0.0002, 2) == "0.02%"
    assert at_most(0.0, 2) == "0.00%"


def test_limits_for_a_train_without_length_are_refused(tmp_path: Path) -> None:
    content = json.loads(sample("CH_Stadler_FLIRT_TPF.train.json").read_text("utf-8"))
    del content["length"]
    (tmp_path / "short.train.json").write_text(json.dumps(content))
    arguments = ["plan", "--train", str(tmp_path / "short.train.json"), "--set", "protect=train"]
    arguments += ["--line", "sample"]
    with pytest.raises(InputError, match="not known; state its length in the train's file"):
        run([*arguments, "-o", str(tmp_path / "a.json")])
