# Every target creates .venv on first use.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help install demo tables test test-all lint bench gpu docs notebooks clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-10s %s\n", $$1, $$2}'

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
	  { echo "make: Blender's bpy needs Python 3.11; found $$($(PYTHON) --version). Name one: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --editable '.[train,render,report,rerun,export,launchers,search,loggers,timm,video,ros,dev]' --constraint constraints.txt
	$(BIN)/python -m phd_exp.fusion  # otherwise the first call of fuse compiles it
	@touch $@

install: $(INSTALLED)  ## create .venv with all extras

demo: $(INSTALLED)  ## render, train the probabilistic model, draw its calibration, print its row of the table
	$(BIN)/python -m phd_exp preset=demo recipe=strong
	$(BIN)/python -m phd_exp report

PRESET ?= paper
RECIPE ?= strong
JOBS ?= 4
MORE ?=
TABLES := preset=$(PRESET) recipe=$(RECIPE) $(MORE)

tables: $(INSTALLED)  ## both tables, JOBS runs at once; PRESET=paper needs a GPU, PRESET=full JOBS=2 a night on two cores; resumes
	$(BIN)/python -m phd_exp -m render data=default,occl,scale,occl_scale $(TABLES)
	$(BIN)/python -m phd_exp -m experiment=table1,table2 $(TABLES) hydra/launcher=joblib hydra.launcher.n_jobs=$(JOBS)
	$(BIN)/python -m phd_exp report

lint: $(INSTALLED)  ## ruff, mypy, import contracts, and a check for known bad releases
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache  # a cache from before a merge reports imports that no longer exist
	$(BIN)/python .ci/audit.py

test: lint  ## lint and the default tests (9 to 17 minutes on 2 cores)
	$(BIN)/python -m pytest -n 2 --dist loadfile
	OPENBLAS_CORETYPE=Prescott $(BIN)/python -m pytest -m kernels tests/fusion/test_fuse.py tests/rendering/test_sequences.py

test-all: lint  ## the slow tests too
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'not bench'

bench: $(INSTALLED)  ## quality and speed against named references
	$(BIN)/python -m pytest tests/benchmarks -m bench

gpu: $(INSTALLED)  ## images a second of training at preset=paper on this machine's GPU, and the wait for data
	$(BIN)/python tests/benchmarks/gpu.py

docs: $(INSTALLED)  ## site/index.html: guides, ideas, and the reference from docstrings
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict  # the variable silences an advertisement of the theme

notebooks: $(INSTALLED)  ## execute the notebooks: minutes, more if runs and data sets are missing
	$(BIN)/python notebooks/execute.py

clean:  ## remove .venv and caches; keep renders/ and runs/
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
