# make demo   bake a bundled example and say where the results are
# make test   everything that has to hold
# make lint   the static part of it
# make chaos  bakes under 200 faults: killed processes, cut wires, flipped bytes, set clocks (about an hour)
# make hostile  thousands of attacks while another client bakes, then schemathesis at length (about half an hour)
# make hostile-commands  every command of the command line with each option at odd values (about an hour)
# make faults  bakes inputs that were once baked wrongly, against right values (about ten minutes)
# make differential  200 random scenes against plain Mitsuba at random texels (about twenty minutes)
# make venv   the virtual environment in .venv that these use

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.PHONY: help venv demo test faults differential hostile hostile-commands lint node chromium faketime chaos clean

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
export PYTHON

help:
	@sed -n 's/^# //p' Makefile

venv: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt deploy/install/venv.sh deploy/install/libllvm.sh
	@deploy/install/venv.sh $(VENV) service,worker,dev
	@deploy/install/libllvm.sh $(VENV)
	@touch $@

demo: venv
	@$(BIN)/lightkiln bake gallery --preset draft --out demo --force

lint: venv
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

node:
	@deploy/install/node.sh

chromium:
	@deploy/install/chromium.sh

faketime:
	@deploy/install/faketime.sh

## Tests that kill processes and time what they do run one after the other, all others side by side.
ALONE := tests/chaos tests/e2e tests/service/test_replicas.py

test: lint node chromium faketime
	$(BIN)/pytest $(ALONE)
	$(BIN)/pytest -n auto --maxprocesses 4 --dist loadfile $(ALONE:%=--ignore=%)

## Where the programs among the tests find what they share.
FARM_TESTS := tests/e2e:tests/store:tests/hostile

hostile: venv
	PYTHONPATH=$(FARM_TESTS) $(BIN)/python tests/hostile/siege.py --json docs/results/hostile.json --page docs/results/hostile.md
	LIGHTKILN_HOSTILE_EXAMPLES=400 $(BIN)/pytest tests/hostile/test_openapi.py -q -rP

hostile-commands: venv
	LIGHTKILN_HOSTILE_COMMANDS=100000 $(BIN)/pytest tests/hostile/test_commands_hostile.py -q -rP

faults: venv
	$(BIN)/python benchmarks/faults.py --json docs/results/faults.json --page docs/results/faults.md

differential: venv
	PYTHONPATH=tests/differential $(BIN)/python tests/differential/differential.py --json docs/results/differential.json --page docs/results/differential.md

chaos: venv faketime
	PYTHONPATH=$(FARM_TESTS) $(BIN)/python tests/chaos/chaos.py --store disk --faults 120 --json docs/results/chaos-disk.json
	PYTHONPATH=$(FARM_TESTS) $(BIN)/python tests/chaos/chaos.py --store s3 --faults 100 --json docs/results/chaos-s3.json

clean:
	rm -rf $(VENV) demo demo.partial
