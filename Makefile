# Needs Linux, Python 3.10 to 3.12, make and a C++ compiler. Everything else goes into .venv.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory
# Tests start dozens of processes; without bytecode on disk each compiles torch and nerfstudio for 12 s anew.
unexport PYTHONDONTWRITEBYTECODE

PYTHON ?=
ARGS ?=
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: help setup test lint format demo constraints clean

help:  ## show this list
	@echo "usage: make TARGET [ARGS='...'] [PYTHON=/path/to/python]"
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: $(STAMP)  ## make .venv with every package at its tested version
	@:

# The script's own changes matter too: they may install something else.
$(STAMP): pyproject.toml constraints.txt scripts/setup.sh
	@PYTHON="$(PYTHON)" scripts/setup.sh
	@touch $@

test: lint  ## lint, then all tests but those that need a GPU (ARGS: pytest's)
	@$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder $(ARGS)

lint: setup  ## check style, formatting and who may import whom
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@PYTHONPATH=. $(BIN)/lint-imports --no-logo

format: setup  ## reformat the code and mend what can be mended
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

demo: setup  ## train a small scene block by block, on the CPU, and show the result (ARGS: abcd demo's)
	@$(BIN)/abcd demo $(ARGS)

constraints: setup  ## pin anew, after the dependencies in pyproject.toml changed
	@scripts/lock.sh

clean:  ## remove caches and build products; .venv and your results stay
	@rm -rf build dist *.egg-info .pytest_cache .hypothesis .ruff_cache .import_linter_cache .coverage
	@find . -path ./.venv -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +
