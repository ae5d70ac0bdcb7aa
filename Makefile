# Two commands on a fresh machine: `make demo` and `make test`. Nothing but Python and the package registry is needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
JOBS ?= 2
PLUGINS := $(wildcard plugins/*)

.PHONY: demo test faults lint format viewers clean

demo: $(INSTALLED)
	$(BIN)/sfm-app demo -o demo

test: $(INSTALLED)
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile

# kill -9, Ctrl-C, full disks and more at 88 points of a run
faults: $(INSTALLED)
	SFM_APP_FAULTS=1 $(BIN)/python -m pytest -n $(JOBS) tests/faults

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(INSTALLED): pyproject.toml constraints.txt $(PLUGINS:=/pyproject.toml)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]' $(PLUGINS:%=-e %)
	touch $@

# RUNS: output folders of finished runs, such as RUNS="demo out"; needs Node
viewers: $(INSTALLED)
	npm --prefix benchmarks/viewers install --no-audit --no-fund --no-package-lock
	$(BIN)/python benchmarks/accuracy/viewers.py $(RUNS)

clean:
	rm -rf $(VENV) demo .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
