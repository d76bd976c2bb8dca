# Every target works on a fresh clone, does its own set-up, and is quick the second time.
PYTHON ?= python3
HOST ?= 127.0.0.1
PORT ?= 8080
DATA_DIR ?= data
DEMO ?= hopper-backflip
OPTIONS ?=
BIN := .venv/bin

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_CONSTRAINT := $(CURDIR)/constraints.txt

.PHONY: run setup test test-fast check chaos soak bench clean

run: .venv/.installed
	$(BIN)/onedemo serve --host "$(HOST)" --port "$(PORT)" --data-dir "$(DATA_DIR)" --demo "$(DEMO)" $(OPTIONS)

setup: .venv/.installed

# Three at once on two cores: those with servers and browsers wait for what others do during a third of their
# time. Tests of one file share servers and browsers and stay together; tests/conftest.py orders the files.
SIDE_BY_SIDE := -n 3 --dist loadfile --no-loadscope-reorder

test: .venv/.installed-test
	$(BIN)/python -m pytest $(SIDE_BY_SIDE)

test-fast: .venv/.installed-test
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m "not seam and not slow"

check: .venv/.installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@rm -rf build/typed && mkdir -p build/typed && cp -R trainer build/typed/onedemo && cp -R app static build/typed/onedemo
	$(BIN)/pyright --level error --pythonpath $(BIN)/python

# The long forms of the tests: chaos takes three quarters of an hour, soak two hours. Their tables of figures are left in promises/.
chaos: .venv/.installed-test
	@mkdir -p promises
	ONEDEMO_LONG=1 $(BIN)/python -m pytest tests/system/test_resume.py tests/system/test_faults.py \
	  tests/browser/test_line.py tests/browser/test_end_to_end.py tests/unit/experiments/test_jobs.py
	$(BIN)/python tests/data/videos.py --long
	PYTHONPATH=tests $(BIN)/python tests/load/fuzz_http.py --json promises/fuzz.json
	PYTHONPATH=tests $(BIN)/python tests/load/attack_http.py --json promises/attack.json
	PYTHONPATH=tests $(BIN)/python tests/load/kill_server.py --json promises/kill.json
	PYTHONPATH=tests $(BIN)/python tests/load/hostile_archives.py --json promises/archives.json
	PYTHONPATH=tests $(BIN)/python tests/load/drawn_server.py --seconds 120 --films 8 --json promises/films.json
	PYTHONPATH=tests $(BIN)/python tests/load/drawn_server.py --seconds 1200 --json promises/drawn.json
	@$(BIN)/python tests/load/promises.py promises/chaos.md promises/kill.json promises/fuzz.json \
	  promises/attack.json promises/archives.json promises/films.json promises/drawn.json

soak: .venv/.installed-test
	@mkdir -p promises
	PYTHONPATH=tests $(BIN)/python tests/load/soak_server.py --json promises/soak.json
	@$(BIN)/python tests/load/promises.py promises/soak.md promises/soak.json

bench: .venv/.installed
	$(BIN)/python -m pip install --quiet --editable '.[bench]'
	$(BIN)/onedemo bench speed --json speed.json --out speed-report
	PYTHONPATH=tests $(BIN)/onedemo bench speed --part load.dataset --part load.product --part load.crowd \
	  --part load.painted --json speed-server.json --out speed-report/server

clean:
	rm -rf .venv build *.egg-info .pytest_cache .ruff_cache

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "onedemo needs Python 3.11 or newer; name one with: make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv .venv

.venv/.installed: pyproject.toml constraints.txt | .venv/bin/python
	@echo "installing onedemo into .venv (a few minutes the first time)"
	$(BIN)/python -m pip install --quiet --editable '.[app]'
	@touch $@

.venv/.installed-test: .venv/.installed tests/install-system.sh
	$(BIN)/python -m pip install --quiet --editable '.[test]'
	@sh tests/install-system.sh
	@touch $@
