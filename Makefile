# From a fresh clone: `make demo`. Needs g++, Python 3.11 or newer with its headers and venv; says so if they are missing.
# Everything goes into .venv; nothing is installed anywhere else. `make help` lists the targets.

PYTHON ?= $(shell .ci/needs --which)
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help build demo serve test test-all check bench clean

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# An index with torch's CPU wheels spares a machine without a GPU two gigabytes; README.md, "Install".
TORCH_CPU := $(if $(SPLATCT_TORCH_INDEX),--extra-index-url $(SPLATCT_TORCH_INDEX))
# What the native core is built with, and how both packages are made; pinned like all else.
BUILD_TOOLS := scikit-build-core nanobind cmake ninja hatchling editables pathspec
SOURCES := $(shell find csrc -type f)

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-9s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

build: $(VENV)/.built  ## everything installed into .venv, the native core compiled

demo: build  ## reconstruct the badly calibrated scan in examples/ and print the scores
	@$(BIN)/splatct demo

serve: build  ## the whole service on this machine, http://127.0.0.1:8080
	@$(BIN)/splatct up

test: build  ## the tests that need no root and no system packages
	@$(BIN)/python -m pytest -q -n 2 --dist loadfile

test-all: build  ## every test but those that need RTK, slow and system ones too; a skip is a failure
	@SPLATCT_NO_SKIPS=1 $(BIN)/python -m pytest -q -m "not rtk"

check: build  ## format, lint, types, import rules
	@$(BIN)/ruff format --check --quiet . || { echo "run: $(BIN)/ruff format ."; exit 1; }
	@$(BIN)/ruff check --quiet .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-logo

bench: build  ## how fast the kernels are; how near calibration comes to knowing the poses
	@$(BIN)/python bench/kernels.py
	@$(BIN)/python bench/ceiling.py examples/head

clean:  ## what was built and cached; .venv and your data stay
	rm -rf build dist $(VENV)/.built .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

# ---- the environment: stamps, so that nothing is done twice ---------------------------------------------

$(BIN)/python:
	@PYTHON='$(PYTHON)' .ci/needs
	@echo "make: a virtual environment in $(VENV)"
	@'$(PYTHON)' -m venv $(VENV)

$(VENV)/.tools: constraints.txt | $(BIN)/python
	@echo "make: installing the pinned build tools"
	@$(PIP) install -c constraints.txt $(BUILD_TOOLS)
	@touch $@

$(VENV)/.built: $(VENV)/.tools pyproject.toml client/pyproject.toml constraints.txt $(SOURCES)
	@PYTHON='$(PYTHON)' .ci/needs
	@echo "make: installing the pinned packages and building the native core (the first time takes minutes: torch is large)"
	@$(PIP) install $(TORCH_CPU) -c constraints.txt --no-build-isolation -e ./client -e '.[dev]'
	@$(PIP) check
	@touch $@
