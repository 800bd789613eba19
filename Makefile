PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
STUDY  ?= quickstart

.PHONY: wheel release site demo studies report test test-fast test-slow test-nightly mutants recompute faults faults-short format lint bench clean

# Python compiles modules at first import. Compiling all installed packages took half of the set-up time.
unexport PYTHONDONTWRITEBYTECODE

# Installs once, and again if the requirements change.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) pfbench/kernels/library_build.py &  # while pip fetches packages
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e ".[dev]"
	touch $@

demo: $(VENV)/.installed        ## quickstart study: two worlds, one report
	$(BIN)/pfbench run -m +experiment=quickstart
	$(BIN)/pfbench run -m +experiment=quickstart_bearings
	$(BIN)/pfbench report study=quickstart

report: $(VENV)/.installed      ## all reports, from results/ or stored runs
	$(BIN)/pfbench report all
	$(BIN)/python experiments/analyses/publish_reports.py

test: $(VENV)/.installed        ## fast and slow tests, without those of the night
	$(BIN)/python -m pytest -n 2 -m "not nightly"

test-nightly: $(VENV)/.site   ## the tests of tests/nightly.txt: three quarters of an hour
	$(BIN)/python -m pytest -n 2 -m nightly

test-fast: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2

test-slow: $(VENV)/.installed
	$(BIN)/python -m pytest -n 2 -m "slow and not nightly"

mutants: $(VENV)/.installed     ## plant each fault of tests/mutants.toml and check that a test of `make test` fails
	$(BIN)/python tests/mutants.py

studies: $(VENV)/.installed     ## run all published studies, cheapest first: about four hours on one idle core; repeat to continue
	$(BIN)/python experiments/analyses/run_studies.py

recompute: $(VENV)/.installed      ## compute the decisions of a report a second time, without code of pfbench; STUDY= for all published ones
	$(BIN)/python tests/recompute.py $(STUDY)

faults: $(VENV)/.installed      ## disturb pfbench and count the outcomes in docs/reliability.md: hours; repeat to continue
	PYTHONPATH=tests $(BIN)/python -m faults.main

faults-short: $(VENV)/.installed   ## a few trials of each class of faults: minutes; writes nothing
	PYTHONPATH=tests $(BIN)/python -m faults.main --short

format: $(VENV)/.installed      ## format the code and apply safe fixes of the linter
	$(BIN)/ruff check --fix-only --quiet .
	$(BIN)/ruff format .

lint: $(VENV)/.installed        ## format, lint, types and spelling, without changes
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/codespell

$(VENV)/.site: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e ".[site]"
	touch $@

site: $(VENV)/.site             ## the site in build/site: tutorials are executed, warnings are errors
	$(BIN)/python experiments/analyses/build_site.py

# particles needs numpy below 2, JAX needs numpy 2: the other libraries have separate environments.
.venv-bench/.installed: benchmarks/requirements.txt
	$(PYTHON) -m venv .venv-bench
	.venv-bench/bin/python -m pip install --quiet --no-compile -r benchmarks/requirements.txt
	touch $@

.venv-peers/.installed: benchmarks/requirements-peers.txt
	$(PYTHON) -m venv .venv-peers
	.venv-peers/bin/python -m pip install --quiet --no-compile -r benchmarks/requirements-peers.txt
	touch $@

bench: $(VENV)/.installed .venv-bench/.installed .venv-peers/.installed   ## speed of other libraries, all methods and job sizes: two hours on an idle machine
	$(BIN)/python benchmarks/compare.py --numba .venv-bench/bin/python --jax .venv-peers/bin/python
	$(BIN)/python benchmarks/campaigns.py --numba .venv-bench/bin/python --jax .venv-peers/bin/python
	$(BIN)/python benchmarks/methods.py
	$(BIN)/python benchmarks/scaling.py
	$(BIN)/python benchmarks/latency.py
	$(BIN)/python benchmarks/online.py

# The tools of a release are locked by their hashes: a later or replaced one is not installed.
$(VENV)/.release: $(VENV)/.installed release-requirements.txt
	$(BIN)/python -m pip install --quiet --require-hashes -r release-requirements.txt
	touch $@

wheel: $(VENV)/.release         ## a wheel in dist/ with a manylinux tag; uploads nothing
	rm -rf build/bdist* build/lib* build/temp* build/wheel dist
	$(BIN)/python -m build --no-isolation --wheel --outdir build/wheel
	PATH="$(BIN):$$PATH" $(BIN)/auditwheel repair --exclude 'libtorch*.so' --exclude 'libc10*.so' --wheel-dir dist build/wheel/*.whl

release: wheel                  ## wheel and source archive in dist/, with checked metadata; uploads nothing
	@grep -q '^date-released: ' CITATION.cff && grep -q '^repository-code: ' CITATION.cff || { echo "CITATION.cff must state date-released and repository-code: docs/release.md, step 1"; exit 1; }
	$(BIN)/python -m build --no-isolation --sdist --outdir dist
	$(BIN)/python -m twine check --strict dist/*

clean:
	rm -rf $(VENV) .venv-bench .venv-peers build dist *.egg-info
