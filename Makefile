# `make demo` and `make test` need nothing but Python >= 3.10, git and make: each makes .venv and installs into it.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LOWEST := .venv-lowest
# Errors only; byte code is compiled when it is first used, which is less of it and later.
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq
INSTALL := $(PIP) install --no-compile
# torch comes first and alone, so that nothing that depends on it chooses another build. TORCH_ARGS is for pip:
# the index of PyTorch's CPU builds, say, which are a tenth of the size of the CUDA builds.
TORCH := $(shell grep '^torch==' constraints.txt)
TORCH_ARGS ?=
TOO_OLD := import sys; sys.exit(sys.version_info < (3, 10) and "Rare Envs needs Python 3.10 or later; \
this one is " + sys.version.split()[0] + ". Name another: make PYTHON=/path/to/python3.11")
# Processes that share the test files among them; each takes up to 2 GB of memory.
WORKERS ?= 2
TESTS := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile
# Kept whatever the environment says: without it every process compiles all libraries anew.
export PYTHONDONTWRITEBYTECODE :=
PACKAGES := agents rare_envs samplers training
SOURCES := $(PACKAGES) tests benchmarks examples

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow test-gpu test-lowest docs lint type format bench clean

help:  ## Show this list.
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1|\2/p' $(MAKEFILE_LIST) | column -t -s '|'

demo: $(VENV)/.installed  ## Train a small PPO ego and estimate how often it collides.
	@$(BIN)/python examples/demo.py

test: $(VENV)/.installed  ## Run the tests (some minutes; WORKERS=8 for more processes than 2).
	@$(TESTS)

test-slow: $(VENV)/.installed  ## Run the repeated-seed studies too.
	@$(TESTS) -m "not gpu"

test-gpu: $(VENV)/.installed  ## Run the tests that need a CUDA device (with a torch that has one).
	@$(TESTS) -m gpu

# Warnings of libraries that are older than those they rest on are none of ours.
test-lowest: $(LOWEST)/.installed  ## Run the tests with the lowest versions that pyproject.toml allows.
	@OMP_NUM_THREADS=1 $(LOWEST)/bin/python -m pytest -n $(WORKERS) --dist loadfile -o filterwarnings=default

lint: $(VENV)/.developer  ## Check style and spelling.
	@$(BIN)/ruff check $(SOURCES) docs
	@$(BIN)/ruff format --check $(SOURCES) docs
	@$(BIN)/codespell $(SOURCES) docs *.md

type: $(VENV)/.developer  ## Check the types of the four packages.
	@$(BIN)/mypy

format: $(VENV)/.developer  ## Format the code and sort the imports.
	@$(BIN)/ruff check --fix $(SOURCES) docs
	@$(BIN)/ruff format $(SOURCES) docs

docs: $(VENV)/.docs  ## Build the documentation site in build/site (Python 3.11 or later).
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "Open build/site/index.html, or run: $(BIN)/python -m mkdocs serve"

bench: $(VENV)/.installed  ## Measure speed against HighwayEnv, and against EnvPool where it installs.
	-@$(INSTALL) -c constraints.txt -e ".[bench]"
	@OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.simulation.throughput

clean:  ## Remove the environment, caches and runs.
	rm -rf $(VENV) $(LOWEST) runs build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c '$(TOO_OLD)'
	@echo "Installing into $(VENV) (first time only) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(INSTALL) $(TORCH_ARGS) "$(TORCH)"
	@$(INSTALL) -c constraints.txt -e ".[test]"
	@touch $@

$(VENV)/.developer: $(VENV)/.installed
	@$(INSTALL) -c constraints.txt -e ".[test,dev]"
	@touch $@

$(VENV)/.docs: $(VENV)/.installed
	@$(INSTALL) -c constraints.txt -e ".[docs]"
	@touch $@

# "matplotlib>=3.9" of pyproject.toml becomes matplotlib==3.9 here.
$(LOWEST)/.installed: pyproject.toml
	@$(PYTHON) -m venv $(LOWEST)
	@grep -oE '"[A-Za-z0-9_-]+>=[0-9.]+' pyproject.toml | tr -d '"' | grep -v setuptools | sed 's/>=/==/' > $(LOWEST)/lowest.txt
	@$(LOWEST)/bin/python -m pip -qq install --no-compile $(TORCH_ARGS) "$$(grep '^torch==' $(LOWEST)/lowest.txt)"
	@$(LOWEST)/bin/python -m pip -qq install --no-compile -c $(LOWEST)/lowest.txt -e ".[test]"
	@touch $@
