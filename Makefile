# Two commands: `make demo` runs the whole chain, `make test` passes the tests.
# Both create .venv from requirements.lock first; both can be repeated and interrupted.

PYTHON ?= python3
ifeq ($(OS),Windows_NT)
BIN := .venv/Scripts
else
BIN := .venv/bin
endif
READY := .venv/ready

# What Python compiles of modules and tests is kept; it took a tenth of the tests' time each time.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo fleet-demo test docs report-pictures wheel portable long check format lock clean

demo: $(READY)
	$(BIN)/trainlog demo --output results

# A hundred trips over a network, two trains with faults, what a fleet shows of them; minutes.
fleet-demo: $(READY)
	$(BIN)/trainlog demo --fleet --output results-fleet

test: $(READY) check
	$(BIN)/python -m pytest -n 2 --dist worksteal

# The documentation's site in build/site; opens from there without a network.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "The documentation is in build/site; 'trainlog docs' opens it."

# The pictures in docs/reports.md; needs Chromium.
report-pictures: $(READY)
	$(BIN)/python docs/tools/report_pictures.py

# The wheel and the source distribution, with the documentation's site in them.
wheel: docs
	$(BIN)/python -m build --no-isolation --outdir dist

# The tests that compare with stored values, as an older processor rounds them.
portable: $(READY)
	NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= OPENBLAS_CORETYPE=Nehalem \
	NPY_DISABLE_CPU_FEATURES="X86_V3 X86_V4 AVX512_ICL AVX512_SPR" \
	$(BIN)/python -m pytest -n 2 tests/test_samples.py tests/test_golden.py

# More than an hour of processor time: kills, whole lines, figures of the papers.
long: $(READY)
	$(BIN)/python -m pytest -m long -n 2 --dist worksteal

check: $(READY)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports

format: $(READY)
	$(BIN)/python -m ruff check --fix .
	$(BIN)/python -m ruff format .

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'trainlog needs Python 3.11 or newer, this is ' + sys.version.split()[0] + '; call make PYTHON=python3.12')"
	@echo "Setting up .venv from requirements.lock; a minute or two ..."
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@$(PYTHON) -c "import pathlib; pathlib.Path('$(READY)').touch()"

# Renews the lock file from pyproject.toml (needs the registry).
lock: $(READY)
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/python -m uv pip compile --quiet --universal --generate-hashes --no-emit-index-url \
		--python-version 3.11 --extra dev --no-annotate pyproject.toml -o requirements.lock

clean:
	rm -rf .venv results build dist
	find trainlog analysis estimators tests benchmarks -name __pycache__ -prune -exec rm -rf {} +
