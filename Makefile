# Every target works on a fresh clone, does its own set-up, and is quick the second time.
PYTHON ?= python3
HOST ?= 127.0.0.1
PORT ?= 8080
DATA_DIR ?= data
DEMO ?= hopper-backflip
OPTIONS ?=
BIN := .venv/bin

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: run setup test test-fast check chaos soak bench clean

run: .venv/.installed
	$(BIN)/onedemo serve --host "$(HOST)" --port "$(PORT)" --data-dir "$(DATA_DIR)" --demo "$(DEMO)" $(OPTIONS)

setup: .venv/.installed

# Side by side on two cores. Those with servers and browsers stay together by file: they share them.
TWO := -n 2
TWO_BY_FILE := -n 2 --dist loadfile --no-loadscope-reorder

test: .venv/.installed-test
	$(BIN)/python -m pytest $(TWO) -m "not seam"
	$(BIN)/python -m pytest $(TWO_BY_FILE) -m seam

test-fast: .venv/.installed-test
	$(BIN)/python -m pytest $(TWO) -m "not seam and not slow"

check: .venv/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --level error --pythonpath $(BIN)/python

# What the tests do in seconds, for long: 20 minutes, and two hours. Tables of figures are left in promises/.
chaos: .venv/.installed-test
	@mkdir -p promises
	ONEDEMO_LONG=1 $(BIN)/python -m pytest tests/test_resume.py tests/test_faults.py
	PYTHONPATH=. $(BIN)/python tests/check_door.py --json promises/door.json
	PYTHONPATH=. $(BIN)/python tests/check_kill.py --json promises/kill.json
	@$(BIN)/python tests/promises.py promises/chaos.md promises/kill.json promises/door.json

soak: .venv/.installed-test
	@mkdir -p promises
	PYTHONPATH=. $(BIN)/python tests/check_soak.py --json promises/soak.json
	@$(BIN)/python tests/promises.py promises/soak.md promises/soak.json

bench: .venv/.installed
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/onedemo bench speed --json speed.json --out speed-report

clean:
	rm -rf .venv *.egg-info .pytest_cache .ruff_cache

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "onedemo needs Python 3.11 or newer; name one with: make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv .venv

.venv/.installed: pyproject.toml | .venv/bin/python
	@echo "installing onedemo into .venv (a few minutes the first time)"
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

.venv/.installed-test: .venv/.installed tests/install-system.sh
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	@sh tests/install-system.sh
	@touch $@
