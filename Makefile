# Two commands matter: `make demo` runs the main job against an emulated radar, `make test` checks everything.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Byte code is left to first use: compiling all of it would add 60 MB.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
DEMO_DIR ?= demo

.PHONY: demo test lint types check clean

$(VENV)/.base: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	@touch $@

$(VENV)/.dev: $(VENV)/.base
	$(PIP) --editable '.[dev]'
	@touch $@

demo: $(VENV)/.base
	$(BIN)/tagid scan --demo --save-dir $(DEMO_DIR)

test: lint types check

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/mypy

check: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/pytest

clean:
	rm -rf $(VENV) $(DEMO_DIR) build dist *.egg-info
