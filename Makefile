# make demo    set up, then draw and analyze a furnished flat (or SCENE=path) into demo-out/
# make test    set up, then run all tests
# make check   what CI runs: format, lint, types, doctests, examples, docs, tests
# make viewer  build the viewer's page into gsvis/viewer; needs Node 20 and npm
# make docs    build the documentation site in site/, links checked
# make stress  run the rooms with processes and sockets five times beside two busy loops a core; docs/results/stress.json
# make repeat  run `make check` ten times beside a busy loop a core; docs/results/check_repeated.json
# make bench   run the benchmarks and write docs/results/<question>.json
# make lowest  run the tests with the lowest versions that pyproject.toml allows, in .venv-lowest
# make fuzz    100,000 damaged inputs to every reader and the wire (INPUTS=, SEED=)
# make kill    kill commands at 100 random moments, resume them, compare what they end with
# make pins    rewrite constraints.txt and requirements.txt from .venv            make clean   remove .venv and all that was built

PYTHON ?= python3
SCENE ?= builtin:flat
OUT ?= demo-out
INPUTS ?= 100000
SEED ?= 1
BIN := .venv/bin
export PYTHON
# Two workers more than cores that this process may use: while some wait for a browser, a server or a kernel, others work.
CORES := $(shell nproc 2>/dev/null)
export PYTEST_XDIST_AUTO_NUM_WORKERS ?= $(if $(CORES),$(shell expr $(CORES) + 2))
# Threads that wait for a kernel sleep: spinning beside other work costs an example ten times its processor time.
export OMP_WAIT_POLICY ?= passive
export OPENBLAS_NUM_THREADS ?= 1
# Tests start hundreds of Python processes: without bytecode each would compile the package anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test check others viewer viewer-check format lint types doctests examples docs bench lowest pins clean fuzz kill stress repeat

help:
	@sed -n 's/^# make/make/p' Makefile

SETUP := pyproject.toml constraints.txt tools/setup.sh

# What `gsvis analyze` and `gsvis view` need: without torch and Open3D it is a third of the size.
.venv/.gsvis: $(SETUP)
	@bash tools/setup.sh report
	@touch $@

.venv/.gsvis-dev: $(SETUP)
	@bash tools/setup.sh all,dev
	@touch .venv/.gsvis $@

.venv/.gsvis-docs: $(SETUP)
	@bash tools/setup.sh all,docs
	@touch .venv/.gsvis $@

# All that the checks need, in one go of pip, which takes half a minute to see that nothing is missing.
.venv/.gsvis-check: $(SETUP)
	@bash tools/setup.sh all,dev,docs
	@touch .venv/.gsvis .venv/.gsvis-dev .venv/.gsvis-docs $@

demo: .venv/.gsvis
	@$(BIN)/gsvis analyze $(SCENE) -o $(OUT) --views 12
	@echo "The report with its pictures: $(OUT)/report.html"
	@echo "Look at the scene in a browser: $(BIN)/gsvis view $(SCENE)"

# A file stays with one worker: what a module prepares for its tests is prepared once.
test: .venv/.gsvis-dev
	@$(BIN)/pytest --numprocesses auto --dist loadfile --no-loadscope-reorder

format: .venv/.gsvis-dev
	@$(BIN)/ruff format --quiet
	@$(BIN)/ruff check --fix --quiet

lint: .venv/.gsvis-dev
	@$(BIN)/ruff format --check
	@$(BIN)/ruff check

types: .venv/.gsvis-dev
	@$(BIN)/mypy

doctests: .venv/.gsvis-dev
	@$(BIN)/python -m pytest -p tests.one_compiler --doctest-modules gsvis --quiet --numprocesses auto --dist loadfile

examples: .venv/.gsvis-dev
	@for example in examples/[0-9]*.py; do \
	    [ -e "$$example" ] || continue; echo "$$example"; $(BIN)/python -W error "$$example" > /dev/null || exit 1; done

# Strict: a warning, such as a link that leads nowhere, is an error.
docs: .venv/.gsvis-docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

viewer/node_modules/.gsvis: viewer/package-lock.json
	@cd viewer && npm ci --no-audit --no-fund --silent
	@touch $@

viewer: viewer/node_modules/.gsvis
	@cd viewer && npm run --silent build

# Types, tests, and whether gsvis/viewer is what its sources build. Users and most contributors have no Node: then nothing is checked.
viewer-check:
	@if command -v npm > /dev/null; then $(MAKE) --no-print-directory viewer/node_modules/.gsvis \
	    && cd viewer && npm run --silent check && npm run --silent test; \
	    else echo "no Node here: the built viewer is not compared with its sources"; fi

# The tests come last: their closing line is the verdict.
check: others test

# All checks but the tests, two at a time: most of them use one core. Doctests use all, and the kernels that examples compiled.
others: .venv/.gsvis-check
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target examples types viewer-check docs lint
	@$(MAKE) --no-print-directory doctests

# Tests that start processes, listen on sockets, lock files or wait for others.
STRESSED := tests/serve tests/stream tests/tools tests/viewer tests/world \
    $(addprefix tests/cli/test_,serve.py view.py world.py process.py pvs.py color.py levels.py) \
    $(addprefix tests/pvs/test_,build.py cluster.py journal.py store.py) \
    tests/simulate/test_link.py $(addprefix tests/files/test_,atomic.py locks.py)

# Kernels are compiled anew in the first run, as for a newcomer. The loops end with the tests, or at the limit.
stress: .venv/.gsvis-dev
	@$(BIN)/python tools/repeat.py --runs 5 --loops 2 --cold --out docs/results/stress.json -- \
	    $(BIN)/pytest --numprocesses auto --dist loadfile $(STRESSED)

repeat: .venv/.gsvis-dev
	@$(BIN)/python tools/repeat.py --runs 10 --loops 1 --out docs/results/check_repeated.json -- $(MAKE) check

bench: .venv/.gsvis-dev
	@mkdir -p docs/results
	@for benchmark in benchmarks/[!_]*.py; do \
	    [ -e "$$benchmark" ] || continue; echo "$$benchmark"; \
	    $(BIN)/python "$$benchmark" --out "docs/results/$$(basename "$$benchmark" .py).json" || [ $$? -eq 77 ] || exit 1; done

# Kernels are cached apart: numba would throw away those of the other version.
lowest: .venv/.gsvis-dev
	@[ -x .venv-lowest/bin/python ] || "$(PYTHON)" -m venv .venv-lowest
	@$(BIN)/python tools/lowest.py > .venv-lowest/constraints.txt
	@.venv-lowest/bin/python -m pip install --quiet --disable-pip-version-check \
	    --constraint .venv-lowest/constraints.txt --editable ".[all,dev]"
	@NUMBA_CACHE_DIR="$(CURDIR)/.venv-lowest/numba" .venv-lowest/bin/python -m pytest --numprocesses auto --dist loadfile

fuzz: .venv/.gsvis-dev
	@mkdir -p docs/results
	@$(BIN)/python tools/fuzz.py --inputs $(INPUTS) --seed $(SEED) --out docs/results/fuzz.json
	@$(BIN)/python tools/fuzz.py --inputs 0 --measured 150 --seed $(SEED) --out docs/results/fuzz_coverage.json

kill: .venv/.gsvis-dev
	@$(BIN)/python tools/kill.py --out docs/results/kill.json

pins: .venv/.gsvis-dev
	@$(BIN)/python tools/pin.py
	@$(BIN)/python tools/pin.py --hashes

clean:
	rm -rf .venv .venv-lowest demo-out build dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find gsvis tests benchmarks examples tools -name __pycache__ -type d -prune -exec rm -rf {} +
