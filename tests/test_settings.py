"""A user's settings: one checked file, which changes what is shown and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
from refusals import refused

from trainlog.errors import InputError
from trainlog.formats.samples import sample
from trainlog.formats.settings import MEANINGS, Settings, read_settings, set_setting

pytestmark = pytest.mark.usefixtures("remembered")

CHECKOUT = Path(__file__).parents[1]


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TRAINLOG_SETTINGS", str(tmp_path / "settings.toml"))
    return tmp_path / "settings.toml"


def test_settings_are_set_shown_and_taken_back(settings, shell, works):
    settings.write_text("# mine\nresults = 'out'\n")
    assert shell("settings", "speed", "mph") == (0, f"wrote {settings}\n", "")
    assert read_settings() == Settings(speed="mph", results="out")
    assert settings.read_text().startswith("# mine\n")
    shown = works("settings")
    assert all(key in shown for key in MEANINGS)
    assert "mph" in shown
    shell("settings", "--unset", "speed")
    assert read_settings() == Settings(results="out")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('zone = "UTC"\nsped = "mph"', "line 2: 'sped' is not a setting; did you mean 'speed'?"),
        ('speed = "knots"', "line 1: speed 'knots' is not a unit of speed; choose one of km/h"),
        ('\n\nzone = "Mars"', "line 3: zone 'Mars' is not known; name one as Europe/Zurich"),
        ("speed = 3", "line 1: speed must be text, not 3; write it as speed ="),
        ("[speed]\nunit = 'mph'", "line 1: speed must be text"),
        ('line = "no.line.json"', "line 1: 'no.line.json' does not exist; name a file"),
        ("speed = ", "is not TOML: "),
    ],
)
def test_what_is_wrong_is_one_error_with_file_line_and_remedy(text, message, settings, shell):
    settings.write_text(text)
    status, _, complaint = shell("show", "--check", sample("nonstop.mcap"))
    assert (status, complaint.count("\n")) == (2, 1)
    assert complaint.startswith(f"trainlog: {settings}")
    assert message in complaint


def test_a_bad_value_is_refused_and_the_file_stays(settings):
    set_setting("zone", "Europe/Zurich")
    before = settings.read_bytes()
    for key, value in (("zone", "Mars"), ("colour", "red"), ("train", "no.json")):
        refused(InputError, "", set_setting, key, value)
    assert settings.read_bytes() == before


def test_units_and_zone_change_what_is_shown_and_no_file(settings, tmp_path, shell):
    log, made = sample("nonstop.mcap"), tmp_path / "made.json"
    shown, files, printed = [], [], []
    for unit, zone in (("km/h", "UTC"), ("mph", "Europe/Zurich")):
        set_setting("speed", unit)
        set_setting("zone", zone)
        _, out, _ = shell("fit", "coasting", log, "-o", made)
        shown.append(out)
        files.append([made.read_bytes(), made.with_suffix(".png").read_bytes()])
        _, out, _ = shell("show", "--check", log, "--json")
        printed.append(out)
    assert files[0] == files[1]
    assert printed[0] == printed[1]
    assert "speed, km/h" in shown[0]
    assert "speed, mph" in shown[1]
    assert "km/h" not in shown[1]
    for zone, shown_as in (("Europe/Zurich", "CEST"), ("+02:00", "UTC+02:00")):
        set_setting("zone", zone)
        _, out, _ = shell("show", log)
        assert f"2024-10-07 08:00:00.000 to 2024-10-07 08:19:43.100 {shown_as}" in out


def test_the_page_lists_the_settings():
    page = (CHECKOUT / "docs" / "command-line.md").read_text("utf-8")
    assert all(f"| `{key}` |" in page and meaning in page for key, meaning in MEANINGS.items())
