# make demo    set up, then analyze a built-in scene (or SCENE=path) into demo-out/
# make test    set up, then run all tests
# make check   what CI runs: format, lint, types, doctests, examples, tests
# make bench   run the benchmarks and write docs/results/<question>.json
# make lowest  run the tests with the lowest versions that pyproject.toml allows, in .venv-lowest
# make fuzz    100,000 damaged inputs to every reader and the wire (INPUTS=, SEED=)
# make pins    rewrite constraints.txt from .venv            make clean   remove .venv and all that was built

PYTHON ?= python3
SCENE ?= builtin:two_rooms
OUT ?= demo-out
INPUTS ?= 100000
SEED ?= 1
BIN := .venv/bin
export PYTHON

.DEFAULT_GOAL := help
.PHONY: help demo test check format lint types doctests examples bench lowest pins clean fuzz

help:
	@sed -n 's/^# make/make/p' Makefile

SETUP := pyproject.toml constraints.txt tools/setup.sh

.venv/.gsvis: $(SETUP)
	@bash tools/setup.sh
	@touch $@

.venv/.gsvis-dev: $(SETUP)
	@bash tools/setup.sh dev
	@touch .venv/.gsvis $@

demo: .venv/.gsvis
	@$(BIN)/gsvis analyze $(SCENE) -o $(OUT)
	@echo "The report with its pictures: $(OUT)/report.html"

# A file stays with one worker: what a module prepares for its tests is prepared once.
test: .venv/.gsvis-dev
	@$(BIN)/pytest --numprocesses auto --dist loadfile

format: .venv/.gsvis-dev
	@$(BIN)/ruff format --quiet
	@$(BIN)/ruff check --fix --quiet

lint: .venv/.gsvis-dev
	@$(BIN)/ruff format --check
	@$(BIN)/ruff check

types: .venv/.gsvis-dev
	@$(BIN)/mypy

doctests: .venv/.gsvis-dev
	@$(BIN)/pytest --doctest-modules gsvis --quiet

examples: .venv/.gsvis-dev
	@for example in examples/[0-9]*.py; do \
	    [ -e "$$example" ] || continue; echo "$$example"; $(BIN)/python -W error "$$example" > /dev/null || exit 1; done

# The tests come last: their closing line is the verdict.
check: lint types doctests examples test

bench: .venv/.gsvis-dev
	@mkdir -p docs/results
	@for benchmark in benchmarks/[!_]*.py; do \
	    [ -e "$$benchmark" ] || continue; echo "$$benchmark"; \
	    $(BIN)/python "$$benchmark" --out "docs/results/$$(basename "$$benchmark" .py).json" || exit 1; done

# Kernels are cached apart: numba would throw away those of the other version.
lowest: .venv/.gsvis-dev
	@[ -x .venv-lowest/bin/python ] || "$(PYTHON)" -m venv .venv-lowest
	@$(BIN)/python tools/lowest.py > .venv-lowest/constraints.txt
	@.venv-lowest/bin/python -m pip install --quiet --disable-pip-version-check \
	    --constraint .venv-lowest/constraints.txt --editable ".[dev]"
	@NUMBA_CACHE_DIR="$(CURDIR)/.venv-lowest/numba" .venv-lowest/bin/python -m pytest --numprocesses auto --dist loadfile

fuzz: .venv/.gsvis-dev
	@mkdir -p docs/results
	@$(BIN)/python tools/fuzz.py --inputs $(INPUTS) --seed $(SEED) --out docs/results/fuzz.json

pins: .venv/.gsvis-dev
	@$(BIN)/python tools/pin.py

clean:
	rm -rf .venv .venv-lowest demo-out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find gsvis tests benchmarks examples tools -name __pycache__ -type d -prune -exec rm -rf {} +
