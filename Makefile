# Each target makes .venv and installs on first use what it needs, the demonstration only imulab itself; afterwards it
# starts at once.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
ALONE := $(if $(wildcard $(STAMP)),$(STAMP),$(VENV)/.alone)
# For what runs as several programs: two at a time, if make was not told otherwise.
BOTH = $(if $(findstring jobserver,$(MAKEFLAGS)),,-j 2)

.PHONY: demo test test-all pytest pytest-reduced pytest-all core fuzz fuzz-core fuzz-readers dist wheel-names lint format bench compare footprint truth truth-all docs clean

demo: $(ALONE)
	$(BIN)/imulab demo demo

# What a person waits for: all but the long statistics (marked slow), with fewer trials and seeds (--reduced); the core
# by itself beside it.
test: $(STAMP)
	$(MAKE) -j 2 core pytest

# The tests start many processes: each would compile what it imports again where the environment forbids to keep it.
pytest pytest-reduced pytest-all: export PYTHONDONTWRITEBYTECODE =
# The matrices of the tests are small: threads of the linear algebra would only wait for each other beside three workers.
pytest pytest-reduced pytest-all: export OPENBLAS_NUM_THREADS = 1

# Three workers for two cores: a good part of the tests waits for a browser, a port or a killed process.
pytest: $(STAMP)
	$(BIN)/python -m pytest -n 3 --dist worksteal --reduced -m "not slow"

# The long statistics too, in their reduced form.
pytest-reduced: $(STAMP)
	$(BIN)/python -m pytest -n 3 --dist worksteal --reduced

# Every seed and thousands of trials.
pytest-all: $(STAMP)
	$(BIN)/python -m pytest -n 2

test-all: core pytest-all

# The C core by itself: double and float, every compiler there is, with sanitizers.
core:
	$(MAKE) $(BOTH) -C runtime test

# The C core, then the readers. Long by default; FUZZ_SECONDS or FUZZ_RUNS bound the core, FUZZ_FILES the changed files
# of each reader.
fuzz: fuzz-core fuzz-readers

fuzz-core:
	$(MAKE) $(BOTH) -C runtime fuzz FUZZ_SECONDS=$(or $(FUZZ_SECONDS),3600)

fuzz-readers: $(STAMP)
	IMULAB_FUZZ=$(or $(FUZZ_FILES),20000) $(BIN)/python -m pytest -q tests/test_readers_fuzz.py

# sdist and wheel; on Linux with the manylinux tag that the wheel earns.
dist: $(VENV)/.release
	rm -rf dist build/wheel
	$(BIN)/python -m build --outdir build/wheel .
	mkdir -p dist && mv build/wheel/*.tar.gz dist/
	if [ "$$(uname)" = Linux ]; then PATH="$(CURDIR)/$(BIN):$$PATH" auditwheel repair -w dist build/wheel/*.whl; \
	else mv build/wheel/*.whl dist/; fi
	ls dist

# Names the wheels that the release workflow builds on the three systems, as a check of their configuration.
wheel-names: $(VENV)/.release
	for system in linux macos windows; do $(BIN)/cibuildwheel --print-build-identifiers --platform $$system . || exit 1; done

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# All of it, quick parts first, into RESULTS.md; BENCH="tumble fleet" measures these parts alone and only prints.
bench: $(STAMP) $(VENV)/.bench
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/run.py $(BENCH)

# What an exported unit costs on a Cortex-M4F, emulated, into docs/runtime.md (Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm).
footprint: $(STAMP)
	$(BIN)/python benchmarks/target.py

# Beside other programs on public recordings; writes benchmarks/comparison.json and the tables of docs/comparison.md.
compare: $(STAMP) $(VENV)/.bench
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/comparison.py

# Coverage, warnings and errors under the disturbances and defaults that people have; writes docs/truth.md, or with
# TRUTH="turns scatter" these sections of it. truth-all makes ten times the trials, 500 at least (some hours).
truth truth-all: $(STAMP)
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/truth/run.py $(if $(filter truth-all,$@),--all) $(TRUTH)

docs: $(STAMP) $(VENV)/.docs
	$(BIN)/python docs/make_commands.py
	$(BIN)/sphinx-build -W -q -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

clean:
	rm -rf $(VENV) demo docs/_build build dist runtime/build

C_SOURCES := $(wildcard src/imulab/*/*.[ch] src/imulab/procedures/*/*.[ch] runtime/*.[ch])

$(STAMP) $(VENV)/.alone: pyproject.toml CMakeLists.txt $(C_SOURCES)
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "imulab needs Python 3.11 or later")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.$(if $(filter $(STAMP),$@),[dev])'
	touch $@

# What else these need: imulab itself is there, and is not built again.
$(VENV)/.release: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'imulab[release]'
	touch $@

$(VENV)/.bench: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'imulab[bench]'
	touch $@

$(VENV)/.docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'imulab[docs]'
	touch $@
