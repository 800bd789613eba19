PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin

.PHONY: demo test test-fast test-slow lint bench clean

# Installs everything once; runs again only when the requirements change.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev]"
	touch $@

demo: $(VENV)/.installed        ## quickstart study: run, compare, report
	$(BIN)/pfbench run -m +experiment=quickstart
	$(BIN)/pfbench report study=quickstart

test: test-fast test-slow       ## fast and slow tests

test-fast: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2

test-slow: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2 -m slow

lint: $(VENV)/.installed
	$(BIN)/ruff check .
	$(BIN)/mypy

# The peer needs numpy below 2, so it lives beside the project's own environment.
.venv-bench/.installed: benchmarks/requirements.txt
	$(PYTHON) -m venv .venv-bench
	.venv-bench/bin/python -m pip install --quiet -r benchmarks/requirements.txt
	touch $@

bench: $(VENV)/.installed .venv-bench/.installed   ## speed against peers and of all methods, ten minutes on a quiet machine
	$(BIN)/python benchmarks/w4.py --peer .venv-bench/bin/python
	$(BIN)/python benchmarks/methods.py

clean:
	rm -rf $(VENV) .venv-bench build dist *.egg-info
