# The commands of the README. Each makes .venv and installs what it needs, once.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help install demo tables test test-all lint bench docs notebooks clean

help:  ## what there is to make
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
	  { echo "make: Blender's bpy needs Python 3.11; found $$($(PYTHON) --version). Say which: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --editable '.[render,report,export,launchers,dev]' --constraint constraints.txt
	$(BIN)/python -m phd_exp.fusion  # else the first call to fuse waits for it
	@touch $@

install: $(INSTALLED)  ## .venv with everything in it

demo: $(INSTALLED)  ## render, train the probabilistic model, draw its calibration, print its row of the table
	$(BIN)/python -m phd_exp preset=demo recipe=strong
	$(BIN)/python -m phd_exp report

PRESET ?= paper
RECIPE ?= strong
JOBS ?= 4
MORE ?=
TABLES := preset=$(PRESET) recipe=$(RECIPE) $(MORE)

tables: $(INSTALLED)  ## both tables, JOBS runs at once; wants a GPU at PRESET=paper, and goes on where it was stopped
	$(BIN)/python -m phd_exp -m render data=default,occl,scale,occl_scale $(TABLES)
	$(BIN)/python -m phd_exp -m experiment=table1,table2 $(TABLES) hydra/launcher=joblib hydra.launcher.n_jobs=$(JOBS)
	$(BIN)/python -m phd_exp report

lint: $(INSTALLED)  ## ruff, mypy, the import floors, and no release that is known to be bad
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache  # a cache survives a merge and then sees imports that are gone
	$(BIN)/python .ci/audit.py

test: lint  ## lint and the default tests (under 5 minutes on 2 cores)
	$(BIN)/python -m pytest -n 2

test-all: lint  ## the slow tests too
	$(BIN)/python -m pytest -n 2 -m 'not bench'

bench: $(INSTALLED)  ## quality and speed, each beside a named reference, in one run
	$(BIN)/python -m pytest tests/benchmarks -m bench

docs: $(INSTALLED)  ## site/index.html: the ideas behind it, and the reference from docstrings
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict  # the variable keeps the theme from praising its successor

notebooks: $(INSTALLED)  ## execute the notebooks, minutes; what runs and data sets are missing takes more
	$(BIN)/python notebooks/execute.py

clean:  ## forget .venv and caches; renders/ and runs/ stay
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
