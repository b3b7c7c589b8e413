# Entry point for all tasks. Each target installs its own dependencies (make setup).
PYTHON ?= python3
VENV := .venv/bin/python
BLENDER_5_3 := .venv-blender-5.3/bin/python
# Fuzz tests with Blender in the process, which then cannot open USD files.
BLENDER_FUZZ := tests/fuzz/test_blender_imports.py
METHOD ?= flod
INPUTS ?= 20000
EFFORT ?= 0.1
PAPERS ?= flod octree clod lodge tree
SCENES ?= examples/lantern_garden examples/lantern_walk
# Lock every dependency in requirements/*.in, for all platforms, with hashes.
LOCK := .venv/bin/uv pip compile --quiet --universal --generate-hashes --no-build --custom-compile-command "make pins"
# One worker per core. Kernels are compiled once into the user's cache.
PYTEST := -m pytest -n auto
# Containers often forbid Python to keep compiled files; then each process compiles all packages again, in seconds.
export PYTHONDONTWRITEBYTECODE :=
quick test test-5.0 test-5.2 nightly fuzz: export OMP_NUM_THREADS := 1  # the workers already use every core
export LODGS_TRAINER_PYTHON := $(CURDIR)/$(VENV)

.PHONY: help setup demo check quick test test-5.0 test-5.2 nightly fuzz attacks lint docs pictures tables bench bench-quality bench-lod bench-tree bench-blocks results extension release pins \
	window interop clean

help:
	@echo "make setup      create the environments from pinned packages (Python 3.11; also 3.13 for Blender 5.3's tests)"
	@echo "make demo       import, train, select, measure and export the example scene (METHOD=flod)"
	@echo "make check      style, types and quick tests, about a minute; run it often"
	@echo "make test       all tests except nightly ones, in Blender 4.5 and, with Python 3.13, in Blender 5.3"
	@echo "make test-5.2   the Blender tests in Blender 5.2 (test-5.0: in 5.0)"
	@echo "make nightly    long tests and those of laboratory tools"
	@echo "make fuzz       20,000 corrupt inputs for every reader, and 2,000 for Blender (INPUTS=20000, SEED=number), some minutes"
	@echo "make lint       style and types"
	@echo "make docs       build/site: the documentation; warnings are errors"
	@echo "make pictures   retake the pictures of docs/images in a real Blender window (needs Blender, Xvfb, ImageMagick)"
	@echo "make tables     regenerate the generated pages of docs/"
	@echo "make bench      speed, as ratios within one run (BASE=old.json compares)"
	@echo "make bench-quality  PSNR and veil over time, all methods (SCENES=\"DIR ...\", METHODS=\"flod ...\", BASE=other checkout, SUBSETS=1 for harder copies)"
	@echo "make bench-lod  levels and chunks on a town of 3 million splats (first run: over an hour; STAGES=\"town lodge others table\")"
	@echo "make bench-tree  cuts of trees with up to 10 million nodes, and training them in 400 MB (first run: an hour, 10 GB)"
	@echo "make bench-blocks  overhead of distributing blocks, and a plot for 1 to 64 workers (half an hour on an idle machine)"
	@echo "make results    docs/methods/results*.md: methods on SCENES and tables of PAPERS (EFFORT=0.1, METHODS=\"flod ...\"; hours)"
	@echo "make extension  dist/lodgs-VERSION.zip, validated by Blender"
	@echo "make release    dist/: extension, its repository, Python package, site, example scene, checksums"
	@echo "make pins       update requirements/*.txt from requirements/*.in (UPGRADE=1 takes the newest allowed versions)"
	@echo "make window     tour in a real Blender window, with screenshots (METHOD=flod; needs Blender, Xvfb, ImageMagick)"
	@echo "make interop    other programs read our files; naga translates our shaders (half an hour; needs Node, Chromium)"
	@echo "make attacks    kill and stop every program at random times; fill disks (two hours)"

setup:
	@command -v $(PYTHON) >/dev/null || { echo "setup: Python is missing; install Python 3.11 with pip." >&2; exit 1; }
	@$(PYTHON) tools/setup.py

demo: setup
	@$(VENV) examples/demo.py --method $(METHOD)

check: setup
	@$(MAKE) --no-print-directory --jobs=2 lint quick

quick: setup
	$(VENV) $(PYTEST) -q -m "not slow and not blender and not nightly"

test: setup
	$(VENV) $(PYTEST) -m "not nightly and not blender" tests/training tests/fuzz
	$(VENV) $(PYTEST) -m "not nightly" tests/blender $(BLENDER_FUZZ)
	@if [ -x $(BLENDER_5_3) ]; then set -x; $(BLENDER_5_3) $(PYTEST) -m "not nightly and not one_blender" tests/blender $(BLENDER_FUZZ); fi

test-5.0 test-5.2: test-%: setup
	@$(PYTHON) tools/setup.py $*
	.venv-blender-$*/bin/python $(PYTEST) tests/blender

nightly: setup
	$(VENV) $(PYTEST) -m nightly tests/training tests/fuzz tests/lab
	$(VENV) $(PYTEST) -m nightly tests/blender
	@if [ -x $(BLENDER_5_3) ]; then set -x; $(BLENDER_5_3) $(PYTEST) -m "nightly or one_blender" tests/blender; fi

fuzz: setup
	LODGS_FUZZ=$(INPUTS) $(VENV) $(PYTEST) -m "not blender" tests/fuzz --timeout 0 $(if $(SEED),--hypothesis-seed $(SEED))
	LODGS_FUZZ=$$(($(INPUTS) / 10)) $(VENV) $(PYTEST) $(BLENDER_FUZZ) --timeout 0 $(if $(SEED),--hypothesis-seed $(SEED))

lint: setup
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/pyrefly check --min-severity error --output-format min-text
	$(VENV) tools/prose.py

docs: setup
	NO_MKDOCS_2_WARNING=1 $(VENV) -m mkdocs build --quiet --strict

pictures: setup
	$(VENV) tools/pictures.py

tables: setup
	$(VENV) tools/tables.py

bench: setup
	$(VENV) tools/bench.py $(if $(BASE),--base $(BASE))
	$(VENV) tools/bench_gpu.py
	$(VENV) tools/bench_blender.py
	@if [ -x $(BLENDER_5_3) ]; then set -x; $(BLENDER_5_3) tools/bench_blender.py; fi

bench-quality: setup
	$(VENV) tools/bench_quality.py $(SCENES) $(if $(SUBSETS),--subsets) $(if $(BASE),--report --base $(BASE)) $(if $(METHODS),--methods $(METHODS))

bench-lod: setup
	$(VENV) lab/bench_lod.py $(STAGES)

bench-tree: setup
	$(VENV) lab/bench_tree.py
	$(VENV) lab/bench_tree_memory.py
	$(VENV) lab/bench_tree_memory.py --times 3 --ways graph --caches 0.25 0.5 1 2 4

bench-blocks: setup
	$(VENV) lab/bench_blocks.py

results: setup
	$(VENV) -m training compare $(SCENES) --out build/results --effort $(EFFORT) --lpips download $(if $(METHODS),--methods $(METHODS))
	for paper in $(PAPERS); do $(VENV) -m training reproduce $$paper --out build/results/$$paper --effort $(EFFORT) || exit 1; done
	$(VENV) tools/results.py build/results --effort $(EFFORT)

extension: setup
	$(VENV) tools/extension.py

release: setup
	$(VENV) tools/release.py $(if $(TAG),--tag $(TAG)) $(if $(SITE),--site $(SITE))

pins: setup
	for name in pip uv trainer cuda cluster develop blender-5.0; do $(LOCK) $(if $(UPGRADE),--upgrade) --python-version 3.11 \
		requirements/$$name.in -o requirements/$$name.txt || exit 1; done
	for name in blender-5.2 blender-5.3; do $(LOCK) $(if $(UPGRADE),--upgrade) --python-version 3.13 \
		requirements/$$name.in -o requirements/$$name.txt || exit 1; done
	$(VENV) tools/blender_versions.py

window: setup
	$(VENV) tools/window.py --method $(METHOD) $(if $(LONG),--long) $(if $(WALK),--walk)

interop: setup
	$(VENV) tools/interop.py
	$(VENV) tools/interop_viewers.py
	$(VENV) tools/interop_usd.py
	$(VENV) tools/shaders.py
	$(VENV) tools/interop_page.py

attacks: setup
	$(VENV) tools/attacks.py
	$(VENV) tools/attacks_commands.py
	$(VENV) tools/attacks_blocks.py
	$(VENV) tools/attacks_blender.py
	@if [ -x $(BLENDER_5_3) ]; then set -x; $(BLENDER_5_3) tools/attacks_blender.py; fi

clean:
	rm -rf build dist .venv .venv-blender-*
