"""What all recursive estimators have in common."""

from __future__ import annotations

import json

import numpy as np
import pytest

from estimators.interface import (
    array_of,
    check_state,
    count_of,
    excitation_of,
    number_of,
    saved_state,
)
from trainlog.errors import InputError


def test_a_saved_state_goes_through_json_and_back() -> None:
    values = np.array([[0.1, np.nan], [1.0 / 3.0, 1e-300]])
    state = saved_state(
        "kind", 3, {"matrix": values, "none": np.empty((0, 2)), "std": np.nan, "count": 4}
    )
    again = json.loads(json.dumps(state, allow_nan=False))
    check_state(again, "kind", 3, ("matrix", "none", "std", "count"))
    np.testing.assert_array_equal(array_of(again, "matrix", (2, 2)), values)
    assert array_of(again, "none", (0, 2)).shape == (0, 2)
    assert np.isnan(number_of(again, "std"))
    assert count_of(again, "count") == 4


def test_a_saved_state_that_does_not_fit_is_refused() -> None:
    state = saved_state("kind", 3, {"matrix": np.eye(2), "count": -1, "word": "many"})
    with pytest.raises(InputError, match="needs 'other', 3"):
        check_state(state, "other", 3, ())
    with pytest.raises(InputError, match="version 3; needs 'kind', 4"):
        check_state(state, "kind", 4, ())
    with pytest.raises(InputError, match="it lacks more"):
        check_state(state, "kind", 3, ("matrix", "more"))
    with pytest.raises(InputError, match=r"matrix has shape \(2, 2\), needs \(3,\)"):
        array_of(state, "matrix", (3,))
    with pytest.raises(InputError, match="word is no array"):
        number_of(state, "word")
    with pytest.raises(InputError, match="count is no count: -1"):
        count_of(state, "count")


def test_excitation_is_that_of_the_worst_direction() -> None:
    prior = np.diag([4.0, 9.0])
    assert excitation_of(prior, prior) == 0.0
    assert excitation_of(np.diag([0.04, 9.0 / 4.0]), prior) == pytest.approx(0.5)
    # Nothing is known of the difference of the two, however well of their sum.
    along = np.array([2.0, -3.0])
    assert excitation_of(np.outer(along, along), prior) == 0.0
    assert excitation_of(np.zeros((2, 2)), prior) == 1.0
