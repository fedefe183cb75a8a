# Each target sets up .venv from nothing but Python 3.11 or later, pip and make.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet -c constraints.txt

.PHONY: demo test test-fast check bench clean

demo: .venv/base            ## the main job on an embedded approach; writes results/demo
	$(BIN)/shortfinal demo --out results/demo

test: .venv/dev             ## all tests
	$(BIN)/pytest

test-fast: .venv/dev        ## without those marked slow, two files at a time
	OMP_NUM_THREADS=1 $(BIN)/pytest -m "not slow" -n 2 --dist loadfile

check: .venv/dev            ## formatting, lint, types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: .venv/dev            ## the solver against its peers, faults, windows, distributions, campaigns, the renderer
	for name in solver threshold_fault window distribution campaigns render tracker; do $(BIN)/python benchmarks/$$name.py || exit 1; done

clean:
	rm -rf .venv results .pytest_cache .ruff_cache .mypy_cache .hypothesis

.venv/bin/python:
	$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'shortfinal needs Python 3.11 or later: make PYTHON=python3.11 ...')"
	$(PYTHON) -m venv .venv
	$(PIP) "pip>=25.1"  # the first that knows dependency groups

.venv/base: .venv/bin/python pyproject.toml constraints.txt
	@echo "installing shortfinal into .venv (once) ..."
	$(PIP) -e .
	@touch $@

.venv/dev: .venv/base
	@echo "installing the training and development tools into .venv (once) ..."
	$(PIP) -e ".[train,data,cluster,posterior,mavlink,mcap]" --group dev
	@touch $@
