PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin

.PHONY: demo report test test-fast test-slow lint bench clean

# Modules are compiled when they are first imported, and kept so: compiling all that is installed took half of the set-up.
unexport PYTHONDONTWRITEBYTECODE

# Installs everything once; runs again only when the requirements change.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e ".[dev]"
	touch $@

demo: $(VENV)/.installed        ## quickstart study: run, compare, report
	$(BIN)/pfbench run -m +experiment=quickstart
	$(BIN)/pfbench report study=quickstart

report: $(VENV)/.installed      ## every published report again, from results/
	$(BIN)/pfbench report all

test: $(VENV)/.installed        ## fast and slow tests
	$(BIN)/python -m pytest -n 2 -m "slow or not slow"

test-fast: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2

test-slow: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2 -m slow

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/mypy

# The library particles needs numpy below 2 and JAX needs it above, so peers live beside the project's own environment.
.venv-bench/.installed: benchmarks/requirements.txt
	$(PYTHON) -m venv .venv-bench
	.venv-bench/bin/python -m pip install --quiet --no-compile -r benchmarks/requirements.txt
	touch $@

.venv-peers/.installed: benchmarks/requirements-peers.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet --no-compile -r benchmarks/requirements-peers.txt
	touch $@

bench: $(VENV)/.installed .venv-bench/.installed .venv-peers/.installed   ## speed against peers, of all methods, against size: two hours of a quiet machine
	$(BIN)/python benchmarks/compare.py --numba .venv-bench/bin/python --jax .venv-peers/bin/python
	$(BIN)/python benchmarks/campaigns.py --numba .venv-bench/bin/python --jax .venv-peers/bin/python
	$(BIN)/python benchmarks/methods.py
	$(BIN)/python benchmarks/scaling.py
	$(BIN)/python benchmarks/pages.py

clean:
	rm -rf $(VENV) .venv-bench .venv-peers build dist *.egg-info
