# Two commands do all the set-up, each from a clean clone: `make demo` and `make test`.
# Needs make and Python 3.11 or newer with venv; everything else is installed into .venv from requirements.lock.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DEMO ?= demo
# The kernels are compiled once and kept here between runs.
export NUMBA_CACHE_DIR ?= $(CURDIR)/$(VENV)/numba-cache

.PHONY: demo test test-all lint types contract docs figures clean help

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1: /p' $(MAKEFILE_LIST)

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("railnav needs Python 3.11 or newer, $(PYTHON) is %d.%d: make PYTHON=python3.x" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	@$(PYTHON) -m venv $(VENV) || { echo "cannot make a virtual environment with $(PYTHON): install its venv module (Debian: python3-venv)" >&2; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $@

demo: $(READY)  ## survey runs -> model -> service run -> solution -> report, in $(DEMO)/
	$(BIN)/railnav demo -o $(DEMO)

test: $(READY)  ## the tests, without the slow ones
	$(BIN)/python -m pytest -q -m "not slow" -n 2

test-all: $(READY)  ## all tests
	$(BIN)/python -m pytest -q -n 2

lint: $(READY)  ## style
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)  ## mypy, strict
	$(BIN)/mypy

contract: $(READY)  ## which room may import which
	$(BIN)/lint-imports

docs: $(READY)  ## regenerate the reference pages
	$(BIN)/python docs/make_cli_reference.py

figures: $(READY)  ## measure again what docs/accuracy.md and docs/performance.md claim
	$(BIN)/python docs/make_figures.py

clean:  ## remove what make made
	rm -rf $(VENV) $(DEMO)
