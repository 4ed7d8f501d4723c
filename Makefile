# The few verbs of this project; `make` alone prints them. Each sets up its environment the first time.
#
#   make analyze LOG=run.mcap [VEHICLE=husky_a200] [ARGS="--yaw imu"]

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= results

# Values reach the shell through its environment, so that a path may hold spaces and quotes.
export LOG LOGS OUT VEHICLE ARGS NAME MINUTES

# Exit code 3 means done, but the log had losses: they are on the screen, and make has not failed.
FORGIVE_LOSSES = || { code=$$?; [ $$code -eq 3 ] && echo "done, with losses (see above)" >&2 || exit $$code; }

# Exit code 4 means that a level moved, which is what was asked.
FORGIVE_ALERTS = || { code=$$?; [ $$code -eq 4 ] && echo "a level moved (see above)" >&2 || exit $$code; }

# A benchmark has one core, and others come first.
ONE_CORE = OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10

.DEFAULT_GOAL := help
.PHONY: analyze audit batch bench browser check clean compare damage-season docs docs-outputs docs-tables format fuzz \
	help inspect lock map measure mysteries pictures published reveal samples screenshots serve test test-long trend wheel

help: ## print this list
	@awk -F ':.*## ' '/^##@ / { print "\n" substr($$0, 5) "\n" } /^[a-z-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' \
		$(firstword $(MAKEFILE_LIST))

analyze: $(VENV)/.ready ## LOG=run.mcap: slip tables, a summary, a report [VEHICLE=, OUT=results, ARGS=]
	@[ -n "$$LOG" ] || { echo "Say which log: make analyze LOG=run.mcap" >&2; exit 2; }
	@if [ -n "$$VEHICLE" ]; then $(BIN)/slip analyze "$$LOG" --results "$$OUT" --vehicle "$$VEHICLE" $$ARGS; \
	else $(BIN)/slip analyze "$$LOG" --results "$$OUT" $$ARGS; fi $(FORGIVE_LOSSES)

inspect: $(VENV)/.ready ## LOG=run.mcap: topics, rates, gaps, clocks, damage
	@[ -n "$$LOG" ] || { echo "Say which log: make inspect LOG=run.mcap" >&2; exit 2; }
	@$(BIN)/slip inspect "$$LOG" $(FORGIVE_LOSSES)

batch: $(VENV)/.ready ## LOGS=dir: analyze the new and changed logs of a folder [OUT=results, ARGS=]
	@[ -n "$$LOGS" ] || { echo "Say which logs: make batch LOGS=dir" >&2; exit 2; }
	@$(BIN)/slip batch "$$LOGS" --results "$$OUT" $$ARGS $(FORGIVE_LOSSES)

compare: $(VENV)/.ready ## deployments in OUT side by side: medians, tests, figure [ARGS=]
	@$(BIN)/slip compare --results "$$OUT" $$ARGS

trend: $(VENV)/.ready ## slip, parameters and data health of the runs in OUT over dates [ARGS=]
	@$(BIN)/slip fleet trend --results "$$OUT" $$ARGS $(FORGIVE_ALERTS)

map: $(VENV)/.ready ## deployments of the literature and runs in OUT by energy and terrain [ARGS=]
	@$(BIN)/slip fleet map --results "$$OUT" $$ARGS

serve: $(VENV)/.ready ## the workbench on this machine: add an effect, watch the error fall [OUT=results, ARGS=]
	@$(BIN)/slip serve --results "$$OUT" $$ARGS

reveal: $(VENV)/.ready ## LOG=data_samples/mystery_1.mcap: the truth of a mystery log beside the diagnosis [OUT=results]
	@[ -n "$$LOG" ] || { echo "Say which log: make reveal LOG=data_samples/mystery_1.mcap" >&2; exit 2; }
	@$(BIN)/python benchmarks game/mystery reveal "$$LOG" "$$OUT"

docs: $(VENV)/.ready-dev ## the handbook as pages that need no network, in build/docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet --config-file docs/mkdocs.yml
	@echo "build/docs/index.html"

wheel: $(VENV)/.ready ## the program as one file to install, in dist
	$(BIN)/python -m hatchling build --target wheel

test: $(VENV)/.ready-dev ## the fast tests
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || \
		echo "no Chromium here: tests that look at pages are left out (make browser)" >&2
	@# Compiled tests are kept where the environment forbids it, too: to compile them takes 15 s per process.
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 2 --dist worksteal -m "not long" --durations=25

clean: ## remove the environment and caches; results stay
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis dist build
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

##@ For developers

check: $(VENV)/.ready-dev ## style, types, and layers of imports
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python benchmarks/house.py

test-long: $(VENV)/.ready-dev ## the tests that take minutes
	$(BIN)/python -m pytest -n 2 -m long
	$(BIN)/python -m pytest -n 2 -m "not long" --hypothesis-profile many tests/fuzz

format: $(VENV)/.ready-dev ## format the code
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

audit: $(VENV)/.ready-dev ## licences and known advisories of the dependencies, and build/sbom.cdx.json
	@$(BIN)/python benchmarks/audit.py $$ARGS

bench: $(VENV)/.ready-dev ## the benchmarks; NAME=reader: one of them [ARGS="--help"]
	@# Some systems have a NAME in the environment: only one that was given to make counts.
	@$(ONE_CORE) $(BIN)/python benchmarks $(if $(findstring command,$(origin NAME)),"$$NAME") $$ARGS

published: $(VENV)/.ready-dev ## public recordings with published answers beside what the program says, where they are [ARGS=FOLDER]
	@$(ONE_CORE) $(BIN)/python benchmarks published $$ARGS

measure: $(VENV)/.ready-dev ## measure what README and handbook say, go on where it was stopped, write the tables [ARGS="paper accuracy rivals_command rivals_measured"]
	@$(ONE_CORE) $(BIN)/python benchmarks measure $$ARGS

docs-tables: $(VENV)/.ready-dev ## write what was measured into README and handbook [ARGS=--check]
	@$(BIN)/python benchmarks measured_tables $$ARGS

docs-outputs: $(VENV)/.ready-dev ## run every command of the handbook and write its output below it [ARGS=docs/pages/symptoms/late.md]
	$(BIN)/python docs/tools/blocks.py --write $$ARGS

screenshots: $(VENV)/.ready-dev ## screenshots of every page on a phone and a laptop, light and dark, in build/screenshots, with layout faults [ARGS="--only report"]
	@$(BIN)/python docs/tools/screenshots.py build/screenshots $$ARGS

pictures: $(VENV)/.ready-dev ## make the handbook's pictures of the report and the workbench again
	$(BIN)/python docs/tools/pictures.py

samples: $(VENV)/.ready ## make the logs in data_samples again
	@for case in husky_tile warthog_ice ackermann_gravel; do \
		$(BIN)/slip simulate $$case --file data_samples/$$case.mcap || exit 1; done

mysteries: $(VENV)/.ready-dev ## make the mystery logs in data_samples again, and their truths
	$(BIN)/python benchmarks game/mystery write data_samples

damage-season: $(VENV)/.ready-dev ## handling of each kind of odd entry in a folder of logs
	$(BIN)/python tests/batch/damage_season.py

fuzz: $(VENV)/.ready-dev ## damaged files for every part of the program, for MINUTES=60 in all; finds are kept in fuzz_finds
	@set -- tests/fuzz/fuzz_*.py; each=$$(awk "BEGIN { print $${MINUTES:-60} / $$# }"); failed=0; \
	for script; do echo "$$script for $$each minutes"; $(BIN)/python "$$script" --minutes "$$each" || failed=1; done; \
	exit $$failed

browser: ## install Debian's Chromium, for the tests that look at the report and the workbench
	apt-get update && apt-get install --yes --no-install-recommends chromium

lock: $(VENV)/.ready-dev ## pin the dependencies of pyproject.toml again
	$(BIN)/uv pip compile pyproject.toml --quiet --universal --python-version 3.11 --generate-hashes \
		--no-emit-index-url --no-header --no-annotate --extra build --output-file requirements.txt
	$(BIN)/uv pip compile pyproject.toml --quiet --universal --python-version 3.11 --generate-hashes \
		--no-emit-index-url --no-header --no-annotate --extra build --extra dask --extra dev --extra docs --extra learn --extra live --extra s3 --extra sim \
		--constraint requirements.txt --output-file requirements-dev.txt

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; say which: make PYTHON=python3.12 ..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.ready: requirements.txt pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@# The program starts .2 s sooner where the environment forbids Python to keep what it compiled.
	@$(BIN)/python -m compileall -q pipeline schemas
	@# Loops are compiled once, here, and not at the first answer.
	@$(BIN)/python -c "from pipeline.cli.verbs_machine import compile_every_loop; compile_every_loop()"
	@touch $@

$(VENV)/.ready-dev: requirements-dev.txt $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements-dev.txt
	@touch $@
