# The few verbs of this project; `make` alone prints them. Each sets up its environment the first time.
#
#   make analyze LOG=run.mcap [VEHICLE=husky_a200] [ARGS="--yaw imu"]

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= results

# Values reach the shell through its environment, so that a path may hold spaces and quotes.
export LOG LOGS OUT VEHICLE ARGS NAME

# Exit code 3 means done, but a log had losses or was refused: that is on the screen, and make has not failed.
FORGIVE_LOSSES = || { code=$$?; [ $$code -eq 3 ] && echo "done, with losses or logs that were refused (see above)" >&2 || exit $$code; }

# Python compiles what it imports, a quarter of what the packages hold.
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

# A benchmark has one core, and others come first.
ONE_CORE = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10

.DEFAULT_GOAL := help
.PHONY: analyze batch bench browser check clean compare docs help hidden-effect release samples serve test test-long

help: ## print this list; `slip --help` lists what the program does
	@awk -F ':.*## ' 'BEGIN { print "For users\n" } /^##@ / { print "\n" substr($$0, 5) "\n" } /^[a-z-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' \
		$(firstword $(MAKEFILE_LIST))

analyze: $(VENV)/.ready ## LOG=run.mcap: slip, its causes, a report [VEHICLE=, OUT=results, ARGS=]
	@[ -n "$$LOG" ] || { echo "Say which log: make analyze LOG=run.mcap" >&2; exit 2; }
	@if [ -n "$$VEHICLE" ]; then $(BIN)/slip analyze "$$LOG" --results "$$OUT" --vehicle "$$VEHICLE" $$ARGS; \
	else $(BIN)/slip analyze "$$LOG" --results "$$OUT" $$ARGS; fi $(FORGIVE_LOSSES)

batch: $(VENV)/.ready ## LOGS=dir: analyze the new and changed logs of a folder [OUT=results, ARGS=]
	@[ -n "$$LOGS" ] || { echo "Say which logs: make batch LOGS=dir" >&2; exit 2; }
	@$(BIN)/slip batch "$$LOGS" --results "$$OUT" $$ARGS $(FORGIVE_LOSSES)

compare: $(VENV)/.ready ## deployments in OUT side by side [ARGS=]
	@$(BIN)/slip compare --results "$$OUT" $$ARGS

serve: $(VENV)/.ready ## the workbench: add an effect, watch the error fall [OUT=results, ARGS=]
	@$(BIN)/slip serve --results "$$OUT" $$ARGS

docs: $(VENV)/.ready-dev ## the handbook as pages that need no network, in build/docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet --config-file docs/mkdocs.yml
	@echo "build/docs/index.html"

test: $(VENV)/.ready-dev ## the fast tests
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || \
		echo "no Chromium here: tests that look at pages are left out (make browser)" >&2
	@# Compiled tests are kept where the environment forbids it, too: to compile them takes 15 s per process.
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 2 --dist worksteal -m "not long and not lint" --durations=25

clean: ## remove the environment and caches; results stay
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis dist build
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

##@ For developers

check: $(VENV)/.ready-dev ## style, types, layers of imports; words, names and links
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python benchmarks/house.py
	$(BIN)/python -m pytest -m "lint and not long"

test-long: $(VENV)/.ready-dev ## the tests that take minutes
	$(BIN)/python -m pytest -n 2 -m long --ignore tests/fuzz
	$(BIN)/python -m pytest -n 2 --hypothesis-profile many tests/fuzz

bench: $(VENV)/.ready-dev ## the benchmarks; NAME=reader: one of them [ARGS="--help"]
	@# Some systems have a NAME in the environment: only one that was given to make counts.
	@$(ONE_CORE) $(BIN)/python benchmarks $(if $(findstring command,$(origin NAME)),"$$NAME") $$ARGS

hidden-effect: $(VENV)/.ready-dev ## draw a log with a hidden effect, diagnose it, score it [ARGS="--category all --seeds 7"]
	@$(ONE_CORE) $(BIN)/python benchmarks game/play $$ARGS

samples: $(VENV)/.ready-dev ## make the simulated logs in data_samples again, and the truths of the mysteries
	@for case in husky_tile warthog_ice ackermann_gravel; do \
		$(BIN)/slip simulate $$case --file data_samples/$$case.mcap --force || exit 1; done
	$(BIN)/python benchmarks game/mystery write data_samples

release: $(VENV)/.ready-dev ## the version of pyproject.toml: checks, tests, wheel, notes and tag, nothing is sent
	@$(BIN)/python packaging/release.py --check
	@$(MAKE) --no-print-directory check test
	@$(BIN)/python packaging/release.py

browser: ## install Debian's Chromium, for the tests that look at pages
	apt-get update && apt-get install --yes --no-install-recommends chromium

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; say which: make PYTHON=python3.12 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.ready: requirements.txt pyproject.toml | $(VENV)/bin/python
	$(PIP) --require-hashes --requirement requirements.txt
	$(PIP) --no-deps --no-build-isolation --editable .
	@# The program starts .2 s sooner where the environment forbids Python to keep what it compiled.
	@$(BIN)/python -m compileall -q -j 0 pipeline schemas slip
	@# Loops are compiled once, here, and not at the first answer; so is what they import of other packages.
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -c "import pipeline.web.server; from pipeline.cli.verbs_machine import compile_every_loop; compile_every_loop()"
	@touch $@

$(VENV)/.ready-dev: requirements-dev.txt $(VENV)/.ready
	$(PIP) --require-hashes --requirement requirements-dev.txt
	@touch $@
