# The front door. Whatever it opens sets up what it needs by itself.
PYTHON ?= python3
VENV := .venv/bin/python
BLENDER_5_3 := .venv-blender-5.3/bin/python
METHOD ?= flod
INPUTS ?= 20000
SCENES ?= examples/lantern_garden examples/lantern_walk
# What is installed, from requirements/*.in, to the last dependency and for every system, with hashes.
LOCK := .venv/bin/uv pip compile --quiet --universal --generate-hashes --no-build --custom-compile-command "make pins"
# One worker a core. Kernels are compiled once, into the user's cache.
PYTEST := -m pytest -n auto
quick test test-5.0 test-5.2 fuzz: export OMP_NUM_THREADS := 1  # torch's threads would come on top of the workers
export LODGS_TRAINER_PYTHON := $(CURDIR)/$(VENV)

.PHONY: help setup demo check quick test test-5.0 test-5.2 fuzz attacks lint docs tables bench bench-quality bench-lod bench-tree bench-blocks extension pins \
	window interop clean

help:
	@echo "make setup      environments from pinned packages (needs Python 3.11; 3.13 for Blender 5.3's tests)"
	@echo "make demo       import, train, select, measure and export the example scene (METHOD=flod)"
	@echo "make check      style, types and the quick tests: about a minute, for every few minutes"
	@echo "make test       all tests, in Blender 4.5 and, with Python 3.13, in Blender 5.3"
	@echo "make test-5.2   the Blender tests in Blender 5.2 (test-5.0: in 5.0)"
	@echo "make fuzz       20,000 spoiled inputs at every door (INPUTS=20000, SEED=a number), some minutes"
	@echo "make lint       style and types"
	@echo "make docs       build/api: the trainer's functions and classes, from their docstrings"
	@echo "make tables     docs/parameters.md and controls.md, from what methods and rules declare"
	@echo "make bench      how fast it is, as ratios from one run"
	@echo "make bench-quality  PSNR and veil against seconds, all methods (SCENES=\"DIR ...\", METHODS=\"flod ...\", BASE=another checkout)"
	@echo "make bench-lod  levels and chunks on a town of 3 million splats (over an hour the first time; STAGES=\"town lodge others table\")"
	@echo "make bench-tree cuts of trees of up to 10 million nodes, and training them in 400 MB (an hour and 10 GB the first time)"
	@echo "make bench-blocks  what giving blocks out costs, and the plot for 1 to 64 workers (half an hour alone)"
	@echo "make extension  dist/lodgs-VERSION.zip, checked by Blender"
	@echo "make pins       requirements/*.txt anew from requirements/*.in (UPGRADE=1 takes the newest of what these leave open)"
	@echo "make window     a tour in a real Blender window, with pictures (METHOD=flod; needs Blender, Xvfb, ImageMagick)"
	@echo "make interop    other programs read our files, naga translates our shaders (needs Node)"
	@echo "make attacks    trainers, workers and a scheduler killed at random moments, disks that fill up: half an hour"

setup:
	@command -v $(PYTHON) >/dev/null || { echo "setup: Python is missing; install Python 3.11 with pip." >&2; exit 1; }
	@$(PYTHON) tools/setup.py

demo: setup
	@$(VENV) examples/demo.py --method $(METHOD)

check: setup
	@$(MAKE) --no-print-directory --jobs=2 lint quick

quick: setup
	$(VENV) $(PYTEST) -q -m "not slow and not blender"

test: setup
	$(VENV) $(PYTEST) tests/training tests/fuzz
	$(VENV) $(PYTEST) tests/blender
	@if [ -x $(BLENDER_5_3) ]; then set -x; $(BLENDER_5_3) $(PYTEST) tests/blender; fi

test-5.0 test-5.2: test-%: setup
	@$(PYTHON) tools/setup.py $*
	.venv-blender-$*/bin/python $(PYTEST) tests/blender

fuzz: setup
	LODGS_FUZZ=$(INPUTS) $(VENV) $(PYTEST) tests/fuzz --timeout 0 $(if $(SEED),--hypothesis-seed $(SEED))

lint: setup
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/pyright

docs: setup
	$(VENV) -m pdoc --docformat google --output-directory build/api training

tables: setup
	$(VENV) tools/tables.py

bench: setup
	$(VENV) tools/bench.py $(if $(BASE),--base $(BASE))
	$(VENV) tools/bench_gpu.py
	$(VENV) tools/bench_blender.py
	@if [ -x $(BLENDER_5_3) ]; then set -x; $(BLENDER_5_3) tools/bench_blender.py; fi

bench-quality: setup
	$(VENV) tools/bench_quality.py $(SCENES) $(if $(BASE),--report --base $(BASE)) $(if $(METHODS),--methods $(METHODS))

bench-lod: setup
	$(VENV) tools/bench_lod.py $(STAGES)

bench-tree: setup
	$(VENV) tools/bench_tree.py
	$(VENV) tools/bench_tree_memory.py

bench-blocks: setup
	$(VENV) tools/bench_blocks.py

extension: setup
	$(VENV) tools/extension.py

pins: setup
	for name in trainer cuda cluster develop blender-5.0; do $(LOCK) $(if $(UPGRADE),--upgrade) --python-version 3.11 \
		requirements/$$name.in -o requirements/$$name.txt || exit 1; done
	for name in blender-5.2 blender-5.3; do $(LOCK) $(if $(UPGRADE),--upgrade) --python-version 3.13 \
		requirements/$$name.in -o requirements/$$name.txt || exit 1; done
	$(VENV) tools/blender_versions.py

window: setup
	$(VENV) tools/window.py --method $(METHOD) $(if $(LONG),--long) $(if $(WALK),--walk)

interop: setup
	$(VENV) tools/interop.py
	$(VENV) tools/shaders.py

attacks: setup
	$(VENV) tools/attacks.py
	$(VENV) tools/attacks_blocks.py

clean:
	rm -rf build dist .venv .venv-blender-*
