"""Which modules the version of an analysis's code stands for: all that are loaded when it runs."""

import subprocess
import sys

import pytest

from trainlog import version


def test_all_modules_that_are_loaded_where_analyses_run_are_part_of_the_version():
    script = """
import sys
from pathlib import Path
from analysis.fleet.work import Batch, Job, computed
from analysis.fleet.analyses import ANALYSES
from trainlog.formats.files import sha256_of
analyses = tuple(ANALYSES.values())
path = Path("sample_logs/nonstop.mcap").absolute()
job = Job("nonstop", sha256_of(path), str(path), tuple(range(len(analyses))))
result = computed(Batch((job,), analyses))
assert not result.unread
assert all(each.state == "done" for part in result.outcomes for each in part)
print(*(name for name in sys.modules if name.startswith(("trainlog", "analysis", "estimators"))))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    loaded = {name for name in done.stdout.split() if version._file_of(name)}
    assert len(loaded) > 80
    known = version._modules_behind("analysis.fleet.work")
    assert loaded <= known


WRITTEN = {
    "def use():\n    import trainlog.other  # noqa: F401\n": True,
    "import os, trainlog.other as short\n": True,
    "try: import trainlog.other\nexcept ImportError: pass\n": True,
    "from .other import one\n": True,
    "from . import (\n    other,  # (see there)\n)\n": True,
    "from trainlog.rest import (\n    rest,  # a (note)\n    one,\n)\nfrom .other import*\n": True,
    "from trainlog \\\n    import other\n": True,
    "x = 'it\\'s'  # it's\nif x: from trainlog import other; x = 1\n": True,
    "from trainlog.rest import first\n": True,
    "from trainlog.rest import *\n": True,
    "import trainlog.rest as rest\n": True,
    '"""\nfrom trainlog import other\n"""\n': False,
    "# import trainlog.other\nx = 'import trainlog.other'\n": False,
    "if TYPE_CHECKING:  # cycle\n    from trainlog.other import (\n        one,\n    )\n": False,
    "from trainlog.rest import second\n": False,
}


@pytest.mark.parametrize("text", WRITTEN)
def test_an_import_counts_however_it_is_written(text, tmp_path, monkeypatch):
    package = tmp_path / "trainlog"
    (package / "rest").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "rest" / "__init__.py").write_text(
        "from trainlog.extras import names_on_first_use\n"
        "if TYPE_CHECKING:\n    from trainlog.other import one\n"
        "    from trainlog.third import second as second\n    first = one\n"
        "__all__, __getattr__, __dir__ = names_on_first_use(__name__, __file__)\n"
    )
    (package / "other.py").write_text("one = 1\n")
    (package / "third.py").write_text("second = 1\n")
    (package / "user.py").write_text(text)
    monkeypatch.setattr(version, "_SOURCE", tmp_path)
    monkeypatch.setattr(version, "_on_first_use", version._on_first_use.__wrapped__)
    before = version.code_version_of.__wrapped__("trainlog.user")
    (package / "other.py").write_text("one = 2\n")
    assert (version.code_version_of.__wrapped__("trainlog.user") != before) is WRITTEN[text]
