# Set-up and jobs; `make` alone lists them. Needs Python 3.11 or newer with venv, and pip's
# network; nothing is installed outside $(VENV).

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
INSTALL := $(PIP) install --constraint constraints.txt --build-constraint constraints.txt

.PHONY: help fit normal-map render test style lint bench notebooks clean
.DEFAULT_GOAL := help

help: ## list the jobs
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' Makefile

fit: $(VENV)/run.stamp ## fit a shadow bias against ray-traced truth, into results/fit
	$(BIN)/python -m experiments fit-bias --out results/fit

normal-map: $(VENV)/run.stamp ## recover a normal map from six images, into results/normal_map
	$(BIN)/python -m experiments fit-normal-map --out results/normal_map

render: $(VENV)/run.stamp ## render a scene with its shadow map, into results/render
	@mkdir -p results/render
	$(BIN)/python -m experiments render --out results/render/image.exr \
	  --png-out results/render/image.png --shadow-map-out results/render/shadow_map.exr

test: $(VENV)/test.stamp ## run the tests
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile \
	  --no-loadscope-reorder $(PYTEST_ARGS)

style: $(VENV)/dev.stamp ## check the form of the code
	$(BIN)/ruff check
	$(BIN)/ruff format --check

lint: style ## check form and types (pyright fetches itself with npm)
	$(BIN)/pyright

bench: $(VENV)/run.stamp ## time the stages (leave the machine alone), into results/bench.json
	@mkdir -p results
	$(BIN)/python -m experiments.benchmarks.stages --out results/bench.json
	$(BIN)/python -m experiments.benchmarks.frames --out results/frames.json
	$(BIN)/python -m experiments.benchmarks.normal_maps --out results/normal_map.json
	$(BIN)/python -m experiments.benchmarks.techniques --out results/techniques.json

notebooks: $(VENV)/test.stamp ## execute the notebooks in place
	$(BIN)/jupyter-execute --inplace notebooks/*.ipynb

clean: ## remove the environment and caches; results stay
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis .jax_cache build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# pip older than 25.1, as a new environment may hold, knows no dependency groups.
$(VENV)/run.stamp: pyproject.toml constraints.txt
	@{ $(PYTHON) -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))'; } \
	  2>/dev/null || { echo 'This needs Python 3.11 or newer with venv; name one, as in' \
	    'make PYTHON=python3.12 (Debian and Ubuntu: apt install python3-venv)' >&2; exit 1; }
	@echo 'Installing into $(VENV), once; this takes a minute or two.'
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --constraint constraints.txt --upgrade pip
	$(INSTALL) --editable .
	@touch $@

$(VENV)/test.stamp: $(VENV)/run.stamp
	$(INSTALL) --group test
	@touch $@

$(VENV)/dev.stamp: $(VENV)/test.stamp
	$(INSTALL) --group dev
	@touch $@
