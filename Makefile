# Needs Python 3.11 or newer and nothing else: everything goes into .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DEV := $(VENV)/.dev

# Tests by marker: `make test` runs those without any of these.
HEAVY := integration or browser or compile or slow
WORKERS ?= 2
PYTEST := $(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal

.PHONY: demo test test-rest test-all coverage faults check docs clean

demo: $(READY)
	$(BIN)/recon demo

test: $(DEV)
	$(PYTEST) -m "not ($(HEAVY))"

# What `make test` leaves out, and the tests by Hypothesis again with all their examples.
test-rest: $(DEV)
	HYPOTHESIS_PROFILE=full $(PYTEST) -m "$(HEAVY) or hypothesis"

test-all: $(DEV)
	HYPOTHESIS_PROFILE=full $(PYTEST) -m ""

coverage: $(DEV)
	$(PYTEST) --cov=recon_cli --cov-report=term

# Kills, full disks, damaged files and hostile inputs, at random from a seed.
SEED ?= 1
COUNT ?= 1000

faults: $(DEV)
	$(BIN)/python tests/faults/run.py --seed $(SEED) --count $(COUNT)

check: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python docs/generate_cli.py --check

docs: $(DEV)
	$(BIN)/python docs/generate_cli.py

clean:
	rm -rf $(VENV)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(DEV): $(READY)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@
