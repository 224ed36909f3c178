"""Templates are valid and ready to edit; TOML equals JSON; a line's table becomes a line."""

from __future__ import annotations

import numpy as np
import pytest
from contents import put
from format_examples import assert_same
from hypothesis import HealthCheck, given, settings, strategies as st
from refusals import refused

from trainlog.declaration import entries, example, meanings
from trainlog.errors import InputError
from trainlog.formats import railway as templates
from trainlog.formats.railway import (
    read_journey,
    read_line,
    read_line_table,
    read_train,
    write_template,
)
from trainlog.ingest import ingest, read_profile
from trainlog.railway import Line, Train
from trainlog.railway.trajectory import Journey

ROUNDING = 5e-14
quick = settings(max_examples=20, suppress_health_check=list(HealthCheck))


@pytest.mark.parametrize(
    ("kind", "read"), [(Line, read_line), (Train, read_train), (Journey, read_journey)]
)
def test_a_template_is_valid_as_it_is(tmp_path, kind, read):
    path = write_template(kind.__name__.lower(), tmp_path / "mine.toml")
    assert_same(read(path), example(kind), ROUNDING)
    text = path.read_text("utf-8")
    assert text.startswith("# A ")
    assert text.count("\n#") > 2


@pytest.mark.parametrize("kind", ["line", "train"])
def test_what_a_template_offers_besides_is_valid_too(tmp_path, kind):
    """Without their marks, the keys in comments at the end are read."""
    offered = templates.template(kind).split("\n# What may be added:\n")[1]
    plain = "\n".join(line.removeprefix("# ") for line in offered.splitlines() if line != "#")
    path = tmp_path / "whole.toml"
    path.write_text(templates.template(kind).split("\n# What may")[0] + "\n" + plain, "utf-8")
    found = read_line(path) if kind == "line" else read_train(path)
    if isinstance(found, Line):
        assert found.curvature(1000.0) == pytest.approx(1.0 / 500.0)
        assert found.tunnels[0].cross_section == 45.0
    else:
        assert found.tunnel_resistance[0][0] == 45.0


@pytest.mark.parametrize("kind", [Line, Train, Journey])
def test_every_key_of_a_template_is_explained(kind):
    """A name, a speed and a number of seats explain themselves."""
    meant = meanings(kind)
    unsaid = {name for entry in entries(kind) for name in entry.names if not meant.get(name)}
    assert unsaid <= {"name", "max_speed", "seats", "coaches", "braking_curves"}


def test_the_profiles_template_reads_what_it_describes(tmp_path):
    """Its optional columns may be missing, the others not."""
    path = write_template("profile", tmp_path / "mine.profile.toml")
    profile = read_profile(path)
    rows = [f"01.05.2024 08:00:{i:02d}.0;{0.02 * i:.2f};72;{50 - 2 * i}" for i in range(40)]
    cells = [row.replace(";0.", ";0,") for row in rows]
    trip = ingest(put(tmp_path / "run.csv", ["Time;Distance;Speed;Effort", *cells]), profile)
    assert trip["/train/state"]["speed"].iloc[0] == pytest.approx(20.0)
    assert trip["/train/controls"]["dynamic_braking_effort"].iloc[-1] == 28_000.0
    assert trip.start.isoformat() == "2024-05-01T06:00:00+00:00"


@pytest.mark.parametrize(
    ("kind", "name", "message"),
    [
        ("train", "mine.json", r"mine\.json: is not the name of a \.toml file"),
        ("profile", "mine.csv", r"mine\.csv: is not the name of a \.toml file"),
        ("line", "there.toml", r"there\.toml: exists; choose another name"),
    ],
)
def test_nothing_is_overwritten(tmp_path, kind, name, message):
    (tmp_path / "there.toml").write_text("edited")
    refused(InputError, message, write_template, kind, tmp_path / name)
    assert (tmp_path / "there.toml").read_text() == "edited"


def test_a_train_is_not_made_from_a_table(tmp_path):
    with pytest.raises(InputError, match="a train cannot be made from a table"):
        write_template("train", tmp_path / "a.toml", table=tmp_path / "b.csv")
    with pytest.raises(InputError, match=r"'trainlog ingest .*b\.csv -o FOLDER' proposes one"):
        write_template("profile", tmp_path / "a.toml", table=tmp_path / "b.csv")


def test_a_table_becomes_a_line(tmp_path):
    path = put(
        tmp_path / "A-B.csv",
        """\
# surveyed 2019
Kilometrierung [km];Neigung [‰];Vmax [km/h];Bahnhof;Radius [m];Breite [deg];Länge [deg]
12,3;0;60;Aach;;47,40;9,30
12,9;;120;;;;
13,8;8,5;;;500;47,41;9,31
15,0;8,5;;Berg;0;;
17,3;-5;80;;-800;47,42;9,33
24,3;;;Chur;;47,44;9,43
""",
    )
    line = read_line_table(path)
    assert (line.name, line.length) == ("A-B", 12_000.0)
    assert line.source == "table A-B.csv; position 0 is km 12.300 of the table"
    assert [s.name for s in line.stations] == ["Aach", "Berg", "Chur"]
    assert [s.position for s in line.stations] == pytest.approx([0.0, 2_700.0, 12_000.0])
    np.testing.assert_allclose(line.speed_limits.positions, [0.0, 600.0, 5_000.0])
    np.testing.assert_allclose(line.speed_limits.values * 3.6, [60, 120, 80])
    np.testing.assert_allclose(line.gradients.positions, [0.0, 1_500.0, 5_000.0])
    np.testing.assert_allclose(line.gradients.values, [0.0, 0.0085, -0.005])
    np.testing.assert_allclose(line.curvature([1_000.0, 2_000.0, 3_000.0, 6_000.0]),
                               [0.0, 1 / 500, 0.0, -1 / 800])  # fmt: skip
    assert line.geometry.latitudes.tolist() == [47.40, 47.41, 47.42, 47.44]
    np.testing.assert_allclose(line.kilometre([0.0, 2_700.0, 12_000.0]) / 1e3, [12.3, 15.0, 24.3])
    assert line.reversed().kilometre(0.0) == pytest.approx(24_300.0)


def test_a_table_whose_kilometres_fall(tmp_path):
    """The same rows with rising and with falling kilometres give the same line."""
    rows, made = ("0;60;A;", ";80;;500", "-25;;;0", ";50;B;"), []
    for kilometres in ((200, 201, 203, 204), (204, 203, 201, 200)):
        cells = [f"{km};{rest}" for km, rest in zip(kilometres, rows, strict=True)]
        head = "km;gradient [permil];limit [km/h];station;radius [m]"
        path = put(tmp_path / "table.csv", [head, *cells])
        made.append(read_line_table(path, name="A-B"))
    rising, falling = made
    assert falling.length == 4_000.0
    assert falling.kilometre([0.0, 1_000.0, 4_000.0]).tolist() == [204e3, 203e3, 200e3]
    at = np.linspace(0.0, 4_000.0, 41)
    for of in (Line.gradient, Line.speed_limit, Line.curvature):
        np.testing.assert_array_equal(of(falling, at), of(rising, at))
    assert falling.stations == rising.stations


@given(st.lists(st.integers(1, 5_000), min_size=1, max_size=30), st.data())
@quick
def test_a_written_table_gives_the_line_again(tmp_path, steps, data):
    """Values hold until the next that is given, whatever cells are empty."""
    at = np.concatenate(([0], 20 + np.cumsum(steps)))
    empty = [data.draw(st.booleans()) and i > 0 for i in range(at.size)]
    limits = [data.draw(st.integers(20, 300)) for _ in at]
    slopes = [data.draw(st.integers(-400, 400)) / 10 for _ in at]
    rows = [
        f"{s / 1000:.3f}\t{'' if no else slope}\t{'' if no else limit}"
        for s, slope, limit, no in zip(at, slopes, limits, empty, strict=True)
    ]
    rows[-1] = f"{at[-1] / 1000:.3f}"
    path = put(tmp_path / "A-B.csv", ["km\tgradient [permil]\tlimit [km/h]", *rows])
    line = read_line_table(path)
    held = slopes[0], limits[0]
    for row in range(at.size - 1):
        held = held if empty[row] else (slopes[row], limits[row])
        middle = 0.5 * (at[row] + at[row + 1])
        assert line.gradient(middle) == pytest.approx(held[0] / 1e3, abs=1e-12)
        assert line.speed_limit(middle) == pytest.approx(held[1] / 3.6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"A-B\.csv: is empty"),
        ("km;limit [km/h]\n0;80\n", r"no column of the gradient; give a header such as 'chainage"),
        ("km;limit\n0;80\n", "no column of the gradient"),
        ("a;b\n0;80\n", r"3 problems: \(1\) line 1: no column of the position; .*\(3\) line 1: no"),
        ("s;gradient [permil];limit [km/h]\n0;1;80\n9;1;80\n", "line 1: column 's' has no unit"),
        ("km;gradient;limit [km/h]\n0;1;80\n9;1;80\n", "'gradient' has no unit; write 'gradient"),
        ("km;gradient [km];limit [km/h]\n0;1;80\n9;1;80\n", r"line 1: column 'gradient': unit"),
        ("km;km [m];gradient [permil];limit [km/h]\n0;0;1;80\n", "are both of the position"),
        ("km;gradient [permil];limit [km/h]\n", "has no row"),
        ("km;gradient [permil];limit [km/h]\n0;1;80\n", "has one row; add a last row"),
        ("km;gradient [permil];limit [km/h]\n0;1;80\n;1;80\n9;;\n", "line 3: has no position"),
        (
            "km;gradient [permil];limit [km/h]\n9;1;80\n5;1;80\n6;;\n0;;\n",
            "line 4: chainage 6000 m follows 5000 m; chainage must fall",
        ),
        (
            "km;gradient [permil];limit [km/h]\n0;1;80\n5;x;80\n4;y;90\n9;;\n",
            r"3 problems: \(1\) line 3, column 'gradient': 'x' is.*\(3\) line 4: chainage 4000",
        ),
        (
            "km;gradient [permil];limit [km/h]\n0;1;80\n5;;80\n4;;90\n3;;90\n9;;\n",
            r"2 problems: \(1\) line 4: chainage 4000 m follows 5000 m; .*\(2\) line 5",
        ),
        ("km;gradient [permil];limit [km/h]\n0;;80\n9;1;80\n", "line 2: no gradient at the line's"),
        ("km;gradient [%];limit [km/h]\n0;25;80\n9;;\n", "steeper than 200 per mille"),
        ("km;gradient [permil];limit [km/h]\n0;5;800\n9;;\n", "800 km/h is not plausible"),
        ("km;gradient [permil];limit [km/h]\n0;5;80;7\n9;;\n", "has 4 cells, the header has 3"),
    ],
)
def test_tables_that_are_no_line(tmp_path, text, message):
    path = put(tmp_path / "A-B.csv", text)
    caught = refused(InputError, message, read_line_table, path)
    assert str(caught).startswith(str(path))
    assert "\n" not in str(caught)
