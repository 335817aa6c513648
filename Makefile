# make demo and make test do all the set-up on a machine that has python >= 3.10 and a C++20 compiler.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
# Files of csrc and its folders, so that a removed file counts as a change too.
NATIVE_SOURCES := $(shell find csrc -name '.*' -prune -o -print 2>/dev/null)
CXX_FILES = $(shell find csrc -type f \( -name '*.cpp' -o -name '*.h' -o -name '*.cu' -o -name '*.cuh' -o -name '*.inl' \))
# Kernels are compiled for the instruction sets of this processor; all is for packages that go to other machines.
TORCHPD_BUILD ?= native
export TORCHPD_BUILD
PYTHONS := python3 python3.14 python3.13 python3.12 python3.11 python3.10
# Modules are compiled once, at their first import, whatever the environment says: torch takes twice as long without.
export PYTHONDONTWRITEBYTECODE :=
PYTEST_ARGS ?=
DEMO_ARGS ?=
BENCH_ARGS ?=

.PHONY: help setup demo test coverage lint format bench cuda-check clean

help:
	@echo "make setup       prepare $(VENV): pinned packages, the compiled extension (the others call it)"
	@echo "make demo        simulate a mesh and draw it        DEMO_ARGS='spot.obj --cells 20'"
	@echo "make test        run the tests                      PYTEST_ARGS='-k doctor'"
	@echo "make coverage    run the tests and report the lines of torchpd/ that they miss"
	@echo "make lint        ruff, mypy and clang-format        make format repairs what can be repaired"
	@echo "make bench       measure the speed                  BENCH_ARGS='--help'"
	@echo "make cuda-check  compile every CUDA source; no GPU needed    CHECK_ARGS=--quick"
	@echo "make clean       remove what was built, but not $(VENV)"

# Two jobs: what the extension is not built with is installed while it is compiled.
setup:
	@$(MAKE) --no-print-directory --jobs=2 $(VENV)/extension.stamp $(VENV)/package.stamp

demo: setup
	$(BIN)/python -m torchpd demo $(DEMO_ARGS)

# A process for each core, of which more than eight would want much memory and speed up little. Tests of a file stay
# together, which share scenes, until a process has none left.
test: setup
	$(BIN)/python -m pytest --numprocesses=auto --maxprocesses=8 --dist=worksteal $(PYTEST_ARGS)

coverage: setup
	$(BIN)/python -m pytest --cov --cov-report=term $(PYTEST_ARGS)

# Without the extension: style and types do not depend on it.
lint: $(VENV)/requirements.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/clang-format --dry-run -Werror $(CXX_FILES)

format: $(VENV)/requirements.stamp
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CXX_FILES)

bench: setup
	$(BIN)/python benchmarks/run.py $(BENCH_ARGS)

cuda-check: $(VENV)/requirements.stamp
	$(BIN)/python tools/cuda_check.py $(CHECK_ARGS)

clean:
	rm -rf build dist *.egg-info torchpd/_C*.so .pytest_cache .mypy_cache .ruff_cache .coverage
	rm -f $(VENV)/extension.stamp $(VENV)/package.stamp
	find torchpd tests tools -name __pycache__ -prune -exec rm -rf {} +

# The pip of the environment is its last piece: without it an interrupted attempt starts again.
$(BIN)/pip:
	@for python in $(PYTHONS); do \
		if $$python -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then \
			$$python -m venv $(VENV) && exit 0; \
			echo "$$python cannot create $(VENV): install its venv module (Debian and Ubuntu: apt install python3-venv)." >&2; \
			exit 1; \
		fi; \
	done; \
	echo "torchpd needs python >= 3.10, but none of [$(PYTHONS)] is: install a newer python." >&2; \
	exit 1

# Modules are byte-compiled when they are first imported: of most nothing ever is.
PIP := $(BIN)/python -m pip install --disable-pip-version-check --no-compile

$(VENV)/build.stamp: requirements/build.txt requirements/lock.txt | $(BIN)/pip
	$(PIP) -r requirements/build.txt -c requirements/lock.txt
	@touch $@

$(VENV)/requirements.stamp: requirements/dev.txt requirements/lock.txt $(VENV)/build.stamp
	$(PIP) --quiet -r requirements/dev.txt -c requirements/lock.txt
	@touch $@

# Object files stay in build/, so that ninja compiles only what changed. It takes the jobs of make for its own, but the
# pipe to them is closed when it starts.
$(VENV)/extension.stamp: $(NATIVE_SOURCES) setup.py torchpd/common/toolkit.py $(VENV)/build.stamp
	env -u MAKEFLAGS $(BIN)/python setup.py --quiet build_ext --inplace
	@touch $@

$(VENV)/package.stamp: pyproject.toml torchpd/version.py $(VENV)/requirements.stamp | $(VENV)/extension.stamp
	$(PIP) --quiet --no-build-isolation --no-deps -e .
	@touch $@
