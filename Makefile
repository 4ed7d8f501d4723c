# The few verbs of this project; `make` alone prints them. Each sets up its environment the first time.
#
#   make analyze LOG=run.mcap [VEHICLE=husky_a200] [ARGS="--yaw imu"]

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= results

# Values reach the shell through its environment, so that a path may hold spaces and quotes.
export ANSWERS FILE LOG LOGS OUT VEHICLE ARGS SEED CATEGORY EFFECT SCORES MINUTES PART

# Exit code 3 means done, but the log had losses: they are on the screen, and make has not failed.
FORGIVE_LOSSES = || { code=$$?; [ $$code -eq 3 ] && echo "done, with losses (see above)" >&2 || exit $$code; }

# Exit code 4 means that a level moved, which is what was asked.
FORGIVE_ALERTS = || { code=$$?; [ $$code -eq 4 ] && echo "a level moved (see above)" >&2 || exit $$code; }

.DEFAULT_GOAL := help
.PHONY: ablate analyze audit batch bench bench-analyze bench-bags bench-batch bench-check bench-constants \
	bench-diagnose bench-export \
	bench-fleet bench-reader bench-real bench-terrain bench-workbench bench-writer browser check clean compare \
	damage damage-results damage-season detection docs docs-outputs docs-tables events few-shot fleets format fuzz help \
	hidden-effect hidden-effect-baselines hidden-effect-score hidden-table inject inspect learned-bands live-replay lock \
	late-starts log-seconds map measure mysteries check-again run-spreads pictures plan-compare plan-game platforms \
	pose-ages reveal rivals samples screenshots serve \
	test \
	test-long trend watch-replay wheel

help: ## print this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

analyze: $(VENV)/.ready ## LOG=run.mcap: slip tables, a summary, a report [VEHICLE=, OUT=results, ARGS=]
	@[ -n "$$LOG" ] || { echo "Say which log: make analyze LOG=run.mcap" >&2; exit 2; }
	@if [ -n "$$VEHICLE" ]; then $(BIN)/slip analyze "$$LOG" --results "$$OUT" --vehicle "$$VEHICLE" $$ARGS; \
	else $(BIN)/slip analyze "$$LOG" --results "$$OUT" $$ARGS; fi $(FORGIVE_LOSSES)

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

inspect: $(VENV)/.ready ## LOG=run.mcap: topics, rates, gaps, clocks, damage
	@[ -n "$$LOG" ] || { echo "Say which log: make inspect LOG=run.mcap" >&2; exit 2; }
	@$(BIN)/slip inspect "$$LOG" $(FORGIVE_LOSSES)

test: $(VENV)/.ready-dev ## the fast tests
	@command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null || \
		echo "no Chromium here: tests that look at pages are left out (make browser)" >&2
	@# Compiled tests are kept where the environment forbids it, too: to compile them takes 15 s per process.
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 2 --dist worksteal -m "not long" --durations=25

test-long: $(VENV)/.ready-dev ## the tests that take minutes
	$(BIN)/python -m pytest -n 2 -m long

check: $(VENV)/.ready-dev ## style, types, and layers of imports
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python benchmarks/house.py

audit: $(VENV)/.ready-dev ## licences and known advisories of the dependencies, and build/sbom.cdx.json
	@$(BIN)/python benchmarks/audit.py $$ARGS

format: $(VENV)/.ready-dev ## format the code
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

docs: $(VENV)/.ready-dev ## the handbook as pages that need no network, in build/docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet --config-file docs/mkdocs.yml
	@echo "build/docs/index.html"

docs-tables: $(VENV)/.ready-dev ## write what was measured into README and handbook [ARGS=--check]
	@$(BIN)/python benchmarks/measured_tables.py $$ARGS

measure: $(VENV)/.ready-dev ## measure what README and handbook say, go on where it was stopped, write the tables [ARGS="paper accuracy rivals_command rivals_measured"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/measure.py $$ARGS

docs-outputs: $(VENV)/.ready-dev ## run every command of the handbook and write its output below it [ARGS=docs/pages/symptoms/late.md]
	$(BIN)/python docs/tools/blocks.py --write $$ARGS

screenshots: $(VENV)/.ready-dev ## screenshots of every page on a phone and a laptop, light and dark, in build/screenshots, with layout faults [ARGS="--only report"]
	@$(BIN)/python docs/tools/screenshots.py build/screenshots $$ARGS

pictures: $(VENV)/.ready-dev ## make the handbook's pictures of the report and the workbench again
	$(BIN)/python docs/tools/pictures.py

wheel: $(VENV)/.ready ## the program as one file to install, in dist
	$(BIN)/python -m hatchling build --target wheel

samples: $(VENV)/.ready ## make the logs in data_samples again
	@for case in husky_tile warthog_ice ackermann_gravel; do \
		$(BIN)/slip simulate $$case --file data_samples/$$case.mcap || exit 1; done

hidden-effect: $(VENV)/.ready-dev ## the public test: make its rings of tasks [ARGS="--out rings --rings open rigid"]; SEED=7: the internal game [CATEGORY=all, EFFECT=, SCORES=file, ARGS=]
	@if [ -n "$$SEED" ]; then $(BIN)/python benchmarks/hidden/play.py --category "$${CATEGORY:-all}" --seeds "$$SEED" \
		$${EFFECT:+--effect "$$EFFECT"} $${SCORES:+--out "$$SCORES" --resume} $$ARGS; \
	else $(BIN)/python benchmarks/hidden_effect/make_rings.py $$ARGS; fi

hidden-effect-score: $(VENV)/.ready-dev ## ANSWERS=dir: score answers to the public test [ARGS="--rings rings --misses"]
	@[ -n "$$ANSWERS" ] || { echo "Say which answers: make hidden-effect-score ANSWERS=dir" >&2; exit 2; }
	@$(BIN)/python benchmarks/hidden_effect/score_answers.py "$$ANSWERS" $$ARGS

hidden-effect-baselines: $(VENV)/.ready-dev ## the baselines of the public test on rings/, with their scores [ARGS="--only sparse slip"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/hidden_effect/run_baselines.py $$ARGS

pose-ages: $(VENV)/.ready-dev ## how near the ages of poses are to those of the gyro where it is withheld [ARGS="LOG... --set NAME=VALUE"]
	@$(BIN)/python benchmarks/pose_ages.py $$ARGS

late-starts: $(VENV)/.ready-dev ## whether starts that the wheels show to be late are late in the gyro, too [ARGS=WORD]
	@$(BIN)/python benchmarks/late_starts.py $$ARGS

ablate: $(VENV)/.ready-dev ## ablation: each rule of the diagnosis off in turn, on drawn logs and the recordings [SEED=81000-81038, SCORES=file, ARGS=]
	@$(BIN)/python benchmarks/hidden/ablate.py --seeds "$${SEED:-81000-81038}" $${SCORES:+--out "$$SCORES" --resume} $$ARGS

hidden-table: $(VENV)/.ready-dev ## SCORES=scores.jsonl: the scores of games played before
	@[ -n "$$SCORES" ] || { echo "Say which: make hidden-table SCORES=scores.jsonl" >&2; exit 2; }
	@$(BIN)/python benchmarks/hidden/play.py --table "$$SCORES"

mysteries: $(VENV)/.ready-dev ## make the mystery logs in data_samples again, and their seals
	$(BIN)/python benchmarks/hidden/mystery.py write data_samples

platforms: $(VENV)/.ready-dev ## results on logs in the layout of popular platforms [ARGS="turtlebot4 panther"]
	@$(BIN)/python benchmarks/platforms.py $$ARGS

reveal: $(VENV)/.ready ## LOG=data_samples/mystery_1.mcap: open the seal of a mystery log, and compare it with the diagnosis [OUT=results]
	@[ -n "$$LOG" ] || { echo "Say which log: make reveal LOG=data_samples/mystery_1.mcap" >&2; exit 2; }
	@$(BIN)/python benchmarks/hidden/mystery.py reveal "$$LOG" "$$OUT"

bench: bench-reader bench-analyze bench-batch bench-check bench-export bench-workbench ## all benchmarks but that on the real recordings

bench-analyze: $(VENV)/.ready-dev ## a whole analysis of a 10-minute log
	$(BIN)/python benchmarks/analyze.py

bench-diagnose: $(VENV)/.ready-dev ## CPU time of a diagnosis and where it goes [LOG=run.mcap, ARGS="--against CHECKOUT"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/diagnose.py $${LOG:+"$$LOG"} $$ARGS

bench-batch: $(VENV)/.ready-dev ## batches of 10, 100 and 1,000 logs, on one and two processes [ARGS="--rounds 5"]
	$(BIN)/python benchmarks/batch.py $$ARGS

damage-results: $(VENV)/.ready-dev ## every byte of small results changed, files deleted, added and swapped: detected or not
	$(BIN)/python benchmarks/damage_results.py $$ARGS

bench-fleet: $(VENV)/.ready-dev ## levels, causes and trends of 300 runs: time and memory [ARGS="--runs 300"]
	$(BIN)/python benchmarks/fleet_speed.py $$ARGS

bench-check: $(VENV)/.ready-dev ## false alarms, power and causes of slip check [PART=null|power|causes|real, ARGS="--pairs 24"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/check.py "$${PART:-null}" $$ARGS

bench-constants: $(VENV)/.ready-dev ## effect of half and double of each constant of a file, or of a sample of all [FILE=pipeline/stages/align.py, ARGS="--sample 40 --diagnosis"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/constants.py $$FILE $$ARGS

bench-terrain: $(VENV)/.ready-dev ## slip by number of passes: drawn drives with truth and without, recordings [PART=drawn|real, ARGS="--runs 6"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/terrain.py "$${PART:-drawn}" $$ARGS

run-spreads: $(VENV)/.ready-dev ## how much lags and dead times differ from run to run of the real recordings [ARGS="--results results"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/run_spreads.py $$ARGS

check-again: $(VENV)/.ready-dev ## the stored measurements of bench-check, evaluated again [FILE=null.jsonl, PART=null|power, ARGS="--trials 400"]
	@[ -n "$$FILE" ] || { echo "Say which: make check-again FILE=null.jsonl" >&2; exit 2; }
	@$(BIN)/python benchmarks/check_again.py "$${PART:-null}" "$$FILE" $$ARGS

bench-export: $(VENV)/.ready-dev ## exporting runs of 1, 3 and 10 hours as MCAP
	$(BIN)/python benchmarks/export.py

bench-real: $(VENV)/.ready-dev ## the right effects on the real recordings [ARGS="--ladders"]
	$(BIN)/python benchmarks/recordings.py $$ARGS

bench-workbench: $(VENV)/.ready-dev ## answers of the workbench on a 10-minute log
	$(BIN)/python benchmarks/workbench.py

bench-reader: $(VENV)/.ready-dev ## reading a 1 GB log: ours, its peers, and the bound
	$(BIN)/python benchmarks/reader.py

bench-bags: $(VENV)/.ready-dev ## reading bags of ROS 1 and ROS 2 beside the same messages as MCAP
	$(BIN)/python benchmarks/bags.py $$ARGS

bench-writer: $(VENV)/.ready-dev ## serializing messages: ours beside mcap-ros2-support
	$(BIN)/python benchmarks/writer.py

rivals: $(VENV)/.ready-dev ## the named physics, models of the literature and learned ones on the real recordings [ARGS="--input measured"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/rivals.py $$ARGS

learned-bands: $(VENV)/.ready-dev ## coverage of the bands of a learned term on a terrain left out
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/learned_bands.py $$ARGS

few-shot: $(VENV)/.ready-dev ## a terrain of OUT left out: error of the fleet's prediction there and of fits to 5, 20, 60 s [OUT=results, ARGS=]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/few_shot.py "$$OUT" $$ARGS

fleets: $(VENV)/.ready-dev ## simulated fleets: levels (vehicle, terrain, run) at which hidden effects are found [ARGS="--fleets 4"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/fleets.py $$ARGS

detection: $(VENV)/.ready-dev ## smallest detectable size of each effect, measured and as the diagnosis states it [ARGS="--seeds 0-20"]
	$(BIN)/python benchmarks/detection.py $$ARGS

inject: $(VENV)/.ready-dev ## faults and effects injected into the real recordings: recovered, reported, missed [ARGS="--logs sand"]
	$(BIN)/python benchmarks/inject.py $$ARGS

plan-game: $(VENV)/.ready-dev ## plans in closed loop: a poor log, a plan, its drive with hidden physics [ARGS="--draws 24"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/plan_game.py $$ARGS

events: $(VENV)/.ready-dev ## digging in, spinning, sliding, stops: found of drawn ones, lead times, false alarms [ARGS="--count 60"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/events.py $(if $(wildcard ../shared/logs),--logs ../shared/logs) $$ARGS

live-replay: $(VENV)/.ready-dev ## cost of `slip watch ws://...`: CPU, memory, delay over a replay [ARGS="--minutes 60 --speed 20"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 5 $(BIN)/python benchmarks/live.py $$ARGS

watch-replay: $(VENV)/.ready-dev ## `slip watch` on growing drawn logs, compared with the final diagnosis [ARGS="--logs 20 --seed 0"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/watch.py $$ARGS

plan-compare: $(VENV)/.ready-dev ## seconds until a question is answered: plans, DRIVE, figure eights, a person [ARGS="--seeds 3"]
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/plan_compare.py $$ARGS

log-seconds: $(VENV)/.ready-dev ## seconds of each real recording that a diagnosis needs, as driven and in the best order
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 nice -n 10 $(BIN)/python benchmarks/log_seconds.py $$ARGS

damage-season: $(VENV)/.ready-dev ## handling of each kind of odd entry in a folder of logs
	$(BIN)/python tests/batch/damage_season.py

fuzz: $(VENV)/.ready-dev ## damaged files for every part of the program, for MINUTES=60 in all; finds are kept in fuzz_finds
	@set -- tests/fuzz/fuzz_*.py; each=$$(awk "BEGIN { print $${MINUTES:-60} / $$# }"); failed=0; \
	for script; do echo "$$script for $$each minutes"; $(BIN)/python "$$script" --minutes "$$each" || failed=1; done; \
	exit $$failed
damage: $(VENV)/.ready-dev ## every byte of small logs damaged: how the reader reports it [ARGS="--step 7"]
	$(BIN)/python benchmarks/damage.py $$ARGS

browser: ## install Debian's Chromium, for the tests that look at the report and the workbench
	apt-get update && apt-get install --yes --no-install-recommends chromium

lock: $(VENV)/.ready-dev ## pin the dependencies of pyproject.toml again
	$(BIN)/uv pip compile pyproject.toml --quiet --universal --python-version 3.11 --generate-hashes \
		--no-emit-index-url --no-header --no-annotate --extra build --output-file requirements.txt
	$(BIN)/uv pip compile pyproject.toml --quiet --universal --python-version 3.11 --generate-hashes \
		--no-emit-index-url --no-header --no-annotate --extra build --extra dask --extra dev --extra docs --extra learn --extra live --extra s3 --extra sim \
		--constraint requirements.txt --output-file requirements-dev.txt

clean: ## remove the environment and caches; results stay
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis dist build
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

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
