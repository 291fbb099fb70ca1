# make demo: install and replay the sample flight. make test: everything that CI checks.
# make deb: a package for Debian or Ubuntu, for this machine's architecture. make docs: the site.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
FLIGHT ?= sample/survey
OUT ?= out/demo

# With it each process of the tests, seven a flight, compiles the whole program anew: a second each.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test lint loops computed flights light opencl clean reference regression settings deb system-test trials docs bench

demo: opencl
	$(BIN)/companion replay $(FLIGHT) --out $(OUT)

# First what only computes, and the checks of types beside it; then flights in real time, one for
# each core, which take 0.8 of one and more: three at once on two cores are all late, and take longer
# than one after the other. Beside them fly those that hardly need a processor. Last what wants the
# computer for itself. Files in which a test fails are run once more, one after the other: a machine
# that others use too may be too busy for one, and in some files one flight goes through all tests.
test: $(VENV)/.installed-dev opencl
	$(MAKE) --no-print-directory --jobs=2 lint computed
	$(MAKE) --no-print-directory --jobs=2 flights light
	$(BIN)/pytest tests/system tests/firmware $(ALONE) $(SLOWEST) || $(ONCE_MORE)

computed: KIND = not real_time
computed: loops
	$(BIN)/pytest -m "$(KIND)" --ignore tests/live --ignore tests/system -n 3 $(IN_ORDER) || $(ONCE_MORE)

flights: $(VENV)/.installed-dev
	$(BIN)/pytest -m "real_time and not light and not alone" $(FLIGHTS) -n $$(nproc) $(IN_ORDER) || \
	  $(ONCE_MORE)

light: CACHE = -o cache_dir=.pytest_cache/light
light: $(VENV)/.installed-dev
	$(BIN)/pytest -m "real_time and light" $(LIGHT) $(CACHE) $(SLOWEST) || $(ONCE_MORE)

# In the order in which they are found, which is that of tests/conftest.py: the longest files first.
# The slowest tests are named at the end.
IN_ORDER = --dist loadfile --no-loadscope-reorder $(SLOWEST)
SLOWEST = --durations 60 --durations-min 2
# Files that are not asked for are not imported: that takes each worker six seconds and more.
ALONE = $(shell grep -l mark.alone tests/live/test_*.py)
LIGHT = $(shell grep -rl --include='test_*.py' real_time tests/unit; grep -l mark.light tests/live/test_*.py)
FLIGHTS = $(filter-out $(ALONE) $(LIGHT), $(shell ls tests/live/test_*.py; grep -rl real_time --include='test_*.py' tests/replay))
KIND = real_time
ONCE_MORE = { [ $$? -eq 1 ] && files=$$($(FAILED_FILES)) && echo "ONCE MORE, one after the other: $$files" && \
  $(BIN)/pytest -m "$(KIND)" $(CACHE) $$files; }
FAILED_FILES = $(BIN)/python -c "import json; \
  failed = json.load(open('.pytest_cache/$(if $(CACHE),light/)v/cache/lastfailed')); \
  print(*sorted({name.partition('::')[0] for name in failed}))"

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

# Compiled once, before the tests begin: else each worker and each flight of them does it.
loops: $(VENV)/.installed-dev
	$(BIN)/python -c "import companion.stages.localisation_work"

# What a change does to the sample flight, against the results that are kept of it.
regression: opencl
	$(BIN)/companion replay sample/survey --out out/regression --set cloud.voxel_m=0.5
	$(BIN)/companion compare sample/reference out/regression --out out/regression \
	  --max-apart 0.3 --max-cloud 0.5

# Keep the results of this version instead.
reference: opencl
	$(BIN)/companion replay sample/survey --out out/reference --set cloud.voxel_m=0.5
	mkdir -p sample/reference
	cp out/reference/trajectory.tum out/reference/cloud.ply out/reference/report.json sample/reference

# config/companion.toml, docs/settings.md and docs/commands.md, after a change to companion/config or companion/app/cli.
settings: $(VENV)/.installed-dev
	$(BIN)/python -m tests.support.settings_text

# A device for the dense map: nothing is installed where one works.
opencl: $(VENV)/.installed
	@sh packaging/opencl.sh $(VENV)

# out/site/index.html; a broken link ends it. That of the other texts is tested by test_documents.py.
docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet
	@echo out/site/index.html

deb:
	sh packaging/build_deb.sh

# How fast this version is beside what is kept of this machine; a slower one is a warning. Some
# minutes; BENCH=--short takes less than one, BENCH=--keep keeps this version's figures instead.
bench: opencl $(VENV)/.installed-dev
	$(BIN)/python -m tests.bench.kept_figures $(BENCH)

# The package on a booted Debian, and the firmwares in their simulators; tests/system and
# tests/firmware say what they need.
system-test: $(VENV)/.installed-dev
	$(BIN)/pytest -s tests/system tests/firmware

# What draws the camera of the trials with firmwares: then `python -m tests.firmware --help`.
trials: $(VENV)/.installed-dev
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[dev,trial]'

# A stamp beside the environment: reinstalled only when the dependencies may have changed.
$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check --editable .
	touch $@

# evo: errors of paths by somebody else's arithmetic (GPL-3: for tests only). Its arithmetic needs
# NumPy and SciPy; its plots want pandas, which pyarrow, where it is installed, imports in each process
# that feeds a viewer: 0.7 s of a processor each, which no installed program takes.
$(VENV)/.installed-dev: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[dev]'
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps 'evo>=1.30'
	touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[docs]'
	touch $@ $(VENV)/.installed

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 14))' || \
	  { echo "companion needs Python 3.10 to 3.13; say which: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || \
	  { echo "Python cannot make an environment here: apt install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

clean:
	rm -rf out build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
	rm -rf .venv
