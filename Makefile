# `make` alone lists the targets. Everything runs in .venv, which `setup` creates and completes; nothing else is needed.
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help setup demo test check bench docs lock clean

ARGS ?=
BIN := .venv/bin
# pyright would otherwise ask the network whether it is the newest.
export PYRIGHT_PYTHON_IGNORE_WARNINGS = 1

help:  ## List the targets
	@echo 'make TARGET [ARGS="..."]'
	@sed -n 's/^\([a-z]*\):.*## /  \1\t/p' Makefile

setup:  ## Create or complete .venv (PYTHON=... names a Python to try first)
	@sh tools/setup.sh

demo: setup  ## Run the demonstration: ARGS go to `swarmnet demo`
	@$(BIN)/swarmnet demo $(ARGS)

test: setup  ## Run the tests on all cores: ARGS go to pytest
	@$(BIN)/pytest -n logical --maxprocesses 8 --dist worksteal $(ARGS)

check: setup  ## Format, lint, check types and imports (with CI=true: only check the format)
	@$(BIN)/ruff format $(if $(filter true,$(CI)),--check)
	@$(BIN)/ruff check
	@$(BIN)/pyright
	@$(BIN)/lint-imports

bench: setup  ## Run the benchmarks: ARGS go to `swarmnet bench`
	@$(BIN)/swarmnet bench $(ARGS)

docs: setup  ## Render docs/results.md from docs/results/*.json
	@$(BIN)/python -m swarmnet.results

lock:  ## Write requirements.lock anew (ARGS=--upgrade for newer versions)
	@sh tools/lock.sh $(ARGS)

clean:  ## Remove .venv, caches and builds; runs/ stays
	@rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache .hypothesis .benchmarks .import_linter_cache
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
