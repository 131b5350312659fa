# Needs GNU make and python3 >= 3.11. `make help` lists what there is.

# Empty: what the sweep's file names, or the emulator.
MODEL ?=
SWEEP ?= baseline
ARGS ?=
RECORDING ?= $(wildcard cache/recordings/$(or $(MODEL),emulator)-$(SWEEP).parquet)
Q ?= select model_left, variant, status, count(*) as trials from trials group by all order by all
PYTHON ?= python3
RUN := .venv/bin/merge-runner
# The compiled tests are kept, or each of its processes would compile them anew each time.
PYTEST := env -u PYTHONDONTWRITEBYTECODE .venv/bin/pytest
export Q
# A make that a recipe runs, as the tests do, is another one: it inherits neither words nor variables.
unexport MODEL SWEEP ARGS RECORDING PYTHON MAKEFLAGS MFLAGS MAKEOVERRIDES

.PHONY: help sweep replay report view sql notebook test lint check check-all bench site lock

help:
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST)

sweep: .venv/runtime $(if $(findstring --dask,$(ARGS)),.venv/dask) ## run a study: MODEL=, SWEEP=, ARGS=
	@$(RUN) sweep $(SWEEP) $(addprefix --model ,$(MODEL)) $(ARGS)

replay: .venv/runtime ## the same from recorded replies alone: MODEL=, SWEEP=, RECORDING=, ARGS=
	@$(RUN) replay $(SWEEP) $(addprefix --model ,$(MODEL)) $(if $(RECORDING),--recording $(RECORDING)) $(ARGS)

report: .venv/runtime ## tables, figures and the HTML report of what the database holds: ARGS=
	@$(RUN) report --out results/report.html --files results/report $(ARGS)

view: .venv/runtime ## the explorer in a browser: ARGS=
	@$(RUN) view $(ARGS)

notebook: .venv/runtime .venv/notebook ## the notebooks of docs/notebooks in JupyterLab: ARGS=
	@.venv/bin/jupyter lab docs/notebooks $(ARGS)

sql: .venv/runtime ## a query over the results: Q="select ...", ARGS=
	@$(RUN) sql "$$Q" $(ARGS)

test: .venv/dev ## the unit tests, or those of ARGS=
	@$(PYTEST) $(or $(ARGS),tests/unit)

lint: .venv/dev ## formatting, lint, types, import contract
	@.venv/bin/ruff format --check .
	@.venv/bin/ruff check .
	@.venv/bin/mypy
	@.venv/bin/lint-imports

check: lint ## what a change must pass: formatting, lint, types, import contract, unit and integration tests
	@$(PYTEST) tests/unit tests/integration $(ARGS)

check-all: check ## make check, the weekly tests, and the wheel on every installed Python: an hour
	@MERGE_RUNNER_BROWSER=required $(PYTEST) tests/weekly $(ARGS)
	@.ci/installed everywhere

bench: .venv/runtime .venv-peer/installed ## the benchmarks: benchmarks/README.md
	@.venv/bin/python -m benchmarks $(ARGS)

site: .venv-site/installed ## the docs as a site, in site/index.html
	@NO_MKDOCS_2_WARNING=1 .venv-site/bin/mkdocs build --strict --quiet $(ARGS)

lock: ## renew the lock files (needs uv)
	uv pip compile $(LOCK) --group dev -o requirements/dev.lock pyproject.toml
	uv pip compile $(LOCK) --group build -c requirements/dev.lock -o requirements/runtime.lock pyproject.toml
	uv pip compile $(LOCK) --extra dask -c requirements/dev.lock $(OTHERS) -o requirements/dask.lock pyproject.toml
	uv pip compile $(LOCK) --group test --resolution lowest-direct -o requirements/lowest.lock pyproject.toml
	uv pip compile $(LOCK) --group pyproject.toml:peer -o requirements/peer.lock
	uv pip compile $(LOCK) --group pyproject.toml:site -o requirements/site.lock

LOCK := --quiet --universal --no-strip-extras --python-version 3.11 --generate-hashes --no-annotate \
	--no-emit-index-url --no-emit-find-links --custom-compile-command "make lock"
# What requirements/runtime.lock has already.
OTHERS = $(shell sed -n 's/^\([a-z0-9-]*\)==.*/--no-emit-package \1/p' requirements/runtime.lock)
PIP := .venv/bin/python -m pip --disable-pip-version-check --quiet

.venv/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "merge-runner needs Python 3.11 or newer: make PYTHON=...")'
	@$(PYTHON) -m venv .venv
	@touch $@

.venv/runtime: .venv/python requirements/runtime.lock pyproject.toml
	@echo "installing the pinned packages into .venv (once, a minute or two)" >&2
	@$(PIP) install --require-hashes -r requirements/runtime.lock
	@$(PIP) install --no-deps --no-build-isolation --editable .
	@touch $@

.venv/dev: .venv/runtime requirements/dev.lock
	@echo "installing the pinned development packages into .venv" >&2
	@$(PIP) install --require-hashes -r requirements/dev.lock
	@touch $@

.venv/dask: .venv/runtime requirements/dask.lock
	@echo "installing the pinned packages of the extra dask into .venv" >&2
	@$(PIP) install --require-hashes --no-deps -r requirements/dask.lock
	@touch $@

.venv/notebook: .venv/runtime
	@echo "installing JupyterLab, the extra notebook, in its newest version into .venv" >&2
	@$(PIP) install --no-build-isolation --editable ".[notebook]"
	@touch $@

.venv-peer/installed: requirements/peer.lock
	@echo "installing inspect-ai, to compare with, into .venv-peer" >&2
	@$(PYTHON) -m venv .venv-peer
	@.venv-peer/bin/python -m pip --disable-pip-version-check --quiet install --require-hashes -r $<
	@touch $@

.venv-site/installed: requirements/site.lock
	@echo "installing mkdocs into .venv-site" >&2
	@$(PYTHON) -m venv .venv-site
	@.venv-site/bin/python -m pip --disable-pip-version-check --quiet install --require-hashes -r $<
	@touch $@
