# make demo   bake a bundled example and say where the results are
# make test   everything that has to hold
# make lint   the static part of it
# make chaos  bakes under 200 faults: killed processes, cut wires, full disks (about an hour; tests run a few)
# make hostile   the long run of schemathesis over the interface
# make venv   the virtual environment in .venv that these use

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.PHONY: help venv demo test hostile lint node chromium chaos clean

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

## Tests that kill processes and time what they do run one after the other, all others side by side.
ALONE := tests/chaos tests/e2e tests/service/test_replicas.py

test: lint node chromium
	$(BIN)/pytest $(ALONE)
	$(BIN)/pytest -n auto --maxprocesses 4 --dist loadfile $(ALONE:%=--ignore=%)

hostile: venv
	LIGHTKILN_HOSTILE_EXAMPLES=400 $(BIN)/pytest tests/hostile/test_openapi.py -q -rP

chaos: venv
	PYTHONPATH=tests/e2e:tests/store $(BIN)/python tests/chaos/chaos.py --store disk --faults 100 --json docs/results/chaos-disk.json
	PYTHONPATH=tests/e2e:tests/store $(BIN)/python tests/chaos/chaos.py --store s3 --faults 100 --json docs/results/chaos-s3.json

clean:
	rm -rf $(VENV) demo demo.partial
