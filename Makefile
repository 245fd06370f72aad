# Needs Python 3.11 or newer and nothing else: everything goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DEV := $(VENV)/.dev

# Tests by marker: `make test` runs those without any of these.
HEAVY := integration or browser or compile or slow
WORKERS ?= 2
ON_ALL := -n $(WORKERS) --dist worksteal
# Tests that start programs wait for them half of the time.
ON_MORE := -n $$(($(WORKERS) * 2)) --dist worksteal
PYTEST := $(BIN)/python -m pytest -q -rs --durations 20 $(ON_ALL)

# The lowest versions that pyproject.toml allows, on the oldest Python that it allows.
OLDEST ?= python3.11
FLOORS := .venv-floors
# Bytecode is kept, whatever the environment says: else each process compiles all modules anew, and
# pytest rewrites each test's assertions.
unexport PYTHONDONTWRITEBYTECODE
.PHONY: demo test times test-other-cpu test-floors test-rest test-all coverage mutants faults check docs clean

demo: $(READY)
	$(BIN)/recon demo

test: $(DEV)
	$(PYTEST) -m "not ($(HEAVY))"

# Numbers round otherwise on other processors: the same tests without torch's vector code, say, or
# OTHER_CPU=NUMBA_CPU_NAME=haswell, the kernels of a laptop with AVX2.
OTHER_CPU ?= ATEN_CPU_CAPABILITY=default

test-other-cpu: $(DEV)
	env $(OTHER_CPU) $(PYTEST) -m "not (browser or compile or slow)" \
	    tests/render tests/train tests/stereo

# Kernels that one version of numba compiled are of no use to another: they have their own place.
test-floors: $(FLOORS)/.ready
	RECON_CACHE_DIR=$(CURDIR)/$(FLOORS)/cache $(FLOORS)/bin/python -m pytest -q $(ON_ALL) \
	    -m "floors and not (browser or slow)" $$(grep -rl "mark.floors" tests --include="test_*.py")

# What `make test` leaves out, and the tests by Hypothesis again with all their examples.
test-rest: $(DEV)
	HYPOTHESIS_PROFILE=full $(PYTEST) $(ON_MORE) -m "$(HEAVY) or hypothesis"

test-all: $(DEV)
	HYPOTHESIS_PROFILE=full $(PYTEST) -m ""

# Where the time of `make test` goes.
times: $(DEV)
	$(BIN)/python tests/time_table.py $(ON_ALL) -m "not ($(HEAVY))"

coverage: $(DEV)
	$(PYTEST) --cov=recon_cli --cov-report=term

# Deliberate breaks of the package, and the first test that notices each: ONLY="--only NAME".
mutants: $(DEV)
	$(BIN)/python tests/mutants.py $(ONLY)

# Kills, full disks, damaged files and hostile inputs, at random from a seed.
SEED ?= 1
COUNT ?= 1000

faults: $(DEV)
	$(BIN)/python tests/faults/run.py --seed $(SEED) --count $(COUNT)

check: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python docs/generate_cli.py --check
	$(BIN)/python docs/generate_api.py --check

# The references, and the manual as a site in build/docs. A link that leads nowhere fails.
docs: $(DEV)
	$(BIN)/python docs/generate_cli.py
	$(BIN)/python docs/generate_api.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) $(FLOORS)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(DEV): $(READY)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

# Nothing is compiled: a version without a wheel fails.
$(FLOORS)/.ready: pyproject.toml tests/floors.py
	$(OLDEST) -m venv $(FLOORS)
	$(FLOORS)/bin/python tests/floors.py pyproject.toml > $(FLOORS)/floors.txt
	$(FLOORS)/bin/pip install --quiet --disable-pip-version-check --only-binary=:all: --no-compile \
	    -c $(FLOORS)/floors.txt -e '.[dev,plot,ray]'
	touch $@
