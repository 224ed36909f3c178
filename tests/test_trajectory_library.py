"""Every track and train of TTOBench, from standstill to standstill."""

from __future__ import annotations

from pathlib import Path

import pytest
from trajectory_cases import drawn, optimised

from trainlog.formats.ttobench import read_track, read_train
from trainlog.railway import Configuration

LIBRARY = Path(__file__).parents[2] / "shared" / "data" / "ttobench"
TRACKS = sorted(path.stem for path in (LIBRARY / "tracks").glob("*.json"))

pytestmark = pytest.mark.skipif(not LIBRARY.exists(), reason=f"{LIBRARY} is not here")


def test_reference_track_and_train_as_published() -> None:
    track = read_track(LIBRARY / "tracks" / "00_reference.json")
    train = read_train(LIBRARY / "trains" / "NL_Intercity_VIRM6.json")
    found = optimised(
        track, train, [Configuration.of(train)], running_time=1541.0, initial_speed=1.0,
        final_speed=10.0,
    )  # fmt: skip
    assert found.certificate["energy"] / (1.06 * train.mass) <= 2802.9


@pytest.mark.parametrize("track", ["CH_Stadelhofen_Altstetten", "00_var_gradient_plus_10"])
def test_short_and_steep_tracks_with_three_configurations(track: str) -> None:
    line = read_track(LIBRARY / "tracks" / f"{track}.json")
    train = read_train(LIBRARY / "trains" / "CH_Stadler_FLIRT_TPF.json")
    found = optimised(line, train, drawn(train, 3, seed=8, spread=0.05), reserve=0.1)
    assert found.certificate["gap"] <= 2e-3


@pytest.mark.long
@pytest.mark.parametrize("track", TRACKS or ["none"])
@pytest.mark.parametrize("objective", ["wheel", "line"])
def test_whole_library(track: str, objective: str) -> None:
    line = read_track(LIBRARY / "tracks" / f"{track}.json")
    for path in sorted((LIBRARY / "trains").glob("*.json")):
        train = read_train(path)
        for reserve in (0.02, 0.05, 0.1, 0.3):
            found = optimised(
                line, train, [Configuration.of(train)], reserve=reserve,
                objective=objective,  # type: ignore[arg-type]
            )  # fmt: skip
            certificate = found.certificate
            assert certificate["audit"]["passed"], path.stem
            assert -1e-6 <= certificate["gap"] <= 2e-3, (path.stem, reserve, certificate["gap"])
            assert len(certificate["solver"]["statuses"]) <= 10
