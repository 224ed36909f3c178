"""The wheel works outside the checkout."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[1]
INSIDE = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")
OUTSIDE = {key: value for key, value in os.environ.items() if key not in INSIDE}
"""The environment of somebody who knows nothing of the checkout."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory"]
    subprocess.run([*command, folder], cwd=CHECKOUT, check=True, capture_output=True, timeout=300)
    (built,) = folder.glob("trainlog-*.whl")
    return built


def environment(folder: Path) -> tuple[Path, Path]:
    """A fresh environment, without pip: its Python and its site-packages."""
    venv.create(folder)
    scripts = folder / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / ("python.exe" if os.name == "nt" else "python")
    base = {"base": str(folder), "platbase": str(folder)}
    return python, Path(sysconfig.get_path("purelib", "venv", base))


def install(python: Path, *arguments: str, timeout: float) -> None:
    """Install into the environment of `python`, by the pip that runs here."""
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
    subprocess.run([*pip, *arguments], check=True, capture_output=True, timeout=timeout)


def trainlog(python: Path, *arguments: str, cwd: Path) -> str:
    done = subprocess.run(
        [python.with_name("trainlog" + python.suffix), *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=300,
        env=OUTSIDE,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def installed_works(python: Path, folder: Path) -> None:
    trainlog(python, "new", "samples", "-o", "samples", cwd=folder)
    logs = sorted((folder / "samples").glob("*.mcap"))
    assert logs
    assert "/train/state" in trainlog(python, "show", str(logs[0]), cwd=folder)
    page, *rest = trainlog(python, "docs", "planner", "--path", cwd=folder).splitlines()
    assert Path(page).is_relative_to(python.parents[1])
    assert "# Planner: " in Path(page).read_text("utf-8") or page.endswith(".html")
    assert page.endswith(".html") != any("make docs" in line for line in rest)


def test_the_wheel_runs_outside_the_checkout(wheel, tmp_path):
    python, site = environment(tmp_path / "environment")
    install(python, "--no-deps", "--no-index", "--no-compile", str(wheel), timeout=300)
    # Third-party packages come from the environment that runs the tests; trainlog does not, as
    # its editable install is not followed from here.
    (site / "third_party.pth").write_text(sysconfig.get_path("purelib") + "\n")
    installed_works(python, tmp_path)


@pytest.mark.long
def test_the_wheel_declares_all_it_needs(wheel, tmp_path):
    python, _ = environment(tmp_path / "environment")
    install(python, str(wheel), timeout=1800)
    installed_works(python, tmp_path)
