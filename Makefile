# Every target sets up all that it needs; run nothing else first.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
# Two processes of one thread each: threads of small arrays would spend half of the time waiting for each other.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# The fast tests of each room; a whole folder if all its tests are fast.
QUICK  := tests/test_imports.py tests/core tests/settings tests/capture tests/occupancy tests/export \
	$(addprefix tests/tracking/test_, tracking.py frame_selection.py dense_alignment.py) \
	$(addprefix tests/gaussians/test_, anchors.py denoising.py splat_ply.py) \
	$(addprefix tests/language/test_, keyframe_choice.py model_packages.py synonyms.py word_matching.py) \
	$(addprefix tests/query/test_, conditions.py oriented_boxes.py region_splitting.py) \
	$(addprefix tests/evaluation/test_, confusion.py restricted_unpickler.py scored_classes.py trajectory_errors.py) \
	$(addprefix tests/tools/test_, peers.py plots.py)

.PHONY: help demo quick test lint fuzz docs wheel-test benchmark mutants setup system clean

demo: setup  ## map the built-in room, ask it by words, write pictures to demo/
	$(BIN)/freeocc3d demo -o demo --overwrite

help:  ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 12

quick: setup lint  ## style, types and the fast tests, in less than two minutes
	$(PYTEST) -q $(QUICK)

test: setup lint  ## style, types and all tests, which build the documentation
	@sh tools/test_clients.sh
	$(PYTEST)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

fuzz: setup  ## try 10,000 damaged inputs of all kinds, and count how they end
	$(BIN)/python tests/fuzz/run.py

docs: setup  ## build the documentation as a site in site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

wheel-test: setup  ## build the wheel, install it into an empty environment, and run its demo
	$(BIN)/python tools/check_wheel.py

benchmark: setup  ## measure maps, ablations and peers
	$(BIN)/python tools/benchmark.py

mutants: setup  ## make small changes, and see which of them the tests notice
	$(BIN)/python tools/mutants.py

setup: system $(STAMP)

$(STAMP): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' || \
		{ echo "freeocc3d needs Python 3.11 or 3.12: run 'make PYTHON=python3.12 $(MAKECMDGOALS)'"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	@echo "Compiling kernels, once, for about half a minute"
	@$(BIN)/python -m freeocc3d.core.ahead_of_time 2>/dev/null || { made=$$(mktemp -d) && \
		{ $(BIN)/freeocc3d demo --frames 12 -o $$made/demo >$$made/log 2>&1 || tail -3 $$made/log >&2; }; rm -rf $$made; }
	@touch $@

# Libraries that the wheels of open3d (libusb, libgomp) and pyvista (EGL, GL) load but do not contain.
system:
	@sh tools/system_libraries.sh

clean:
	rm -rf $(VENV) demo site build dist *.egg-info freeocc3d/core/compiled
