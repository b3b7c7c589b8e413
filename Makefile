# The front door. `make demo` and `make test` set up what they need by themselves.
PYTHON ?= python3
VENV := .venv/bin/python
BLENDER_5_2 := .venv-blender-5.2/bin/python
METHOD ?= flod
PYTEST := -m pytest
export LODGS_TRAINER_PYTHON := $(CURDIR)/$(VENV)

.PHONY: help setup demo test test-5.0 lint bench extension window interop clean

help:
	@echo "make setup      environments from pinned packages (needs Python 3.11; 3.13 for Blender 5.2's tests)"
	@echo "make demo       import, train, select, measure and export the example scene (METHOD=flod)"
	@echo "make test       all tests, in Blender 4.5 and, with Python 3.13, in Blender 5.2"
	@echo "make lint       style and types"
	@echo "make bench      how fast it is, as ratios from one run"
	@echo "make extension  dist/lodgs-VERSION.zip, checked by Blender"
	@echo "make window     a tour in a real Blender window, with pictures (METHOD=flod; needs Blender, Xvfb, ImageMagick)"
	@echo "make interop    other programs read our files (needs Node)"

setup:
	@command -v $(PYTHON) >/dev/null || { echo "setup: Python is missing; install Python 3.11 with pip." >&2; exit 1; }
	@$(PYTHON) tools/setup.py

demo: setup
	@$(VENV) examples/demo.py --method $(METHOD)

test: setup
	$(VENV) $(PYTEST) tests/training
	$(VENV) $(PYTEST) tests/blender
	@if [ -x $(BLENDER_5_2) ]; then set -x; $(BLENDER_5_2) $(PYTEST) tests/blender; fi

test-5.0: setup
	@$(PYTHON) tools/setup.py 5.0
	.venv-blender-5.0/bin/python $(PYTEST) tests/blender

lint: setup
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/pyright

bench: setup
	$(VENV) tools/bench.py $(if $(BASE),--base $(BASE))
	$(VENV) tools/bench_blender.py
	@if [ -x $(BLENDER_5_2) ]; then set -x; $(BLENDER_5_2) tools/bench_blender.py; fi

extension: setup
	$(VENV) tools/extension.py

window: setup
	$(VENV) tools/window.py --method $(METHOD) $(if $(LONG),--long)

interop: setup
	$(VENV) tools/interop.py

clean:
	rm -rf build dist .venv .venv-blender-5.2 .venv-blender-5.0
