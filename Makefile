# Two commands matter: `make demo` runs the main job against an emulated radar, `make test` checks everything.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Byte code is left to first use: compiling all of it would add 60 MB.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
DEMO_DIR ?= demo

.PHONY: demo test lint types docs check browser clean

$(VENV)/.base: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	@touch $@

$(VENV)/.dev: $(VENV)/.base firmware_tools/pyproject.toml
	$(PIP) --editable '.[dev]' --editable ./firmware_tools
	@touch $@

# For Linux the package index has torch with gigabytes of CUDA packages. A build without them comes from an index that
# TORCH_INDEX or pip's own configuration names; where none does, the tests of torch are skipped with that reason.
TORCH_INDEX ?=
TORCH = $(PIP) $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
$(VENV)/.torch: $(VENV)/.dev
	@if selected=$$($(TORCH) --dry-run --no-deps --ignore-installed --report - torch 2>/dev/null) \
	  && ! printf '%s' "$$selected" | grep -Eq '"(nvidia|cuda)-'; then \
	  $(TORCH) --editable '.[ats,export]'; \
	else \
	  echo "torch is left out: pip finds no build without CUDA. Its tests are skipped; see TORCH_INDEX in README.md"; \
	fi
	@touch $@

demo: $(VENV)/.base
	PYTHONDONTWRITEBYTECODE=1 $(BIN)/tagid scan --demo --save-dir $(DEMO_DIR)
	@echo "the same in a browser, on a tablet or phone: $(BIN)/tagid station --demo"

test: lint types docs check

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(VENV)/.dev
	$(BIN)/mypy

# The pages of docs/ as a site in build/site; a broken link is an error.
docs: $(VENV)/.dev
	$(BIN)/mkdocs build --strict --quiet

# The page of `tagid report` is tested in a real Chromium. Where it is not there and may not be installed, those
# tests are skipped and say why.
browser:
	@if ! command -v chromedriver >/dev/null && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
	  echo "installing Chromium for the tests of the page"; \
	  { apt-get update -qq && apt-get install -qq -y --no-install-recommends chromium chromium-driver; } \
	    >/dev/null 2>&1 || echo "Chromium could not be installed"; \
	fi

# Scans wait for radars and tables in real time: three processes keep two cores busy, two do not.
WORKERS = $(shell $(BIN)/python -c "import os; print(max(2, 3 * (os.cpu_count() or 1) // 2))")

# Byte code is kept, whatever the environment says: seven processes collect the tests, which start hundreds of others.
PYTEST = PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/pytest --dist worksteal

check: $(VENV)/.torch browser
	$(PYTEST) -n $(WORKERS) -m "not realtime"
	$(PYTEST) -n 2 -m realtime

clean:
	rm -rf $(VENV) $(DEMO_DIR) build dist *.egg-info
