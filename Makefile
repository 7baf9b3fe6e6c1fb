# make demo and make test do all the set-up that they need; nothing else has to be run first.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

.PHONY: demo test lint setup system benchmark docs clean

demo: setup  ## build the built-in room, map it, ask it three words, write pictures to demo/
	$(BIN)/freeocc3d demo -o demo --overwrite

test: setup lint
	@sh tools/test_clients.sh
	$(BIN)/python -m pytest -n 2 --dist loadfile

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: setup  ## build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

benchmark: setup
	$(BIN)/python tools/benchmark.py

setup: system $(STAMP)

$(STAMP): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' || \
		{ echo "freeocc3d needs Python 3.11 or 3.12: run 'make PYTHON=python3.12 $(MAKECMDGOALS)'"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	@touch $@

# Libraries that the wheels of open3d (libusb, libgomp) and pyvista (EGL, GL) load but do not carry.
system:
	@sh tools/system_libraries.sh

clean:
	rm -rf $(VENV) demo site build dist *.egg-info
