# `make demo` and `make test` work from a fresh checkout; everything is installed into .venv.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed
KERNELS := $(VENV)/.kernels
LOWEST := $(VENV)/lowest

# Tests and pages start hundreds of processes, none of which should compile the package anew.
unexport PYTHONDONTWRITEBYTECODE

# Of the large tests: how much of them `make test-all` runs.
SHARE  ?= 1
# Module by module, so that a module's fixtures are made once; in the order of tests/conftest.py.
PYTEST := pytest -n auto --dist loadfile --no-loadscope-reorder

DEMO_CONFIG := sample_configs/landing.toml
DEMO        := demo

.PHONY: help install runtime demo quick test tests test-all test-lowest lint kernels lint-and-kernels bench docs docs-and-test clean

help:
	@echo "make demo         simulate a landing movie, analyse it, say where the report is"
	@echo "make quick        style, types, the tests of the rooms that changed since the last commit"
	@echo "make test         style, types, architecture, docstrings, tests"
	@echo "make test-all     the same with coverage, and the large tests: statistics, random kills"
	@echo "make test-lowest  unit and physics tests with the lowest versions that pyproject.toml admits"
	@echo "make lint         style, types, architecture, docstrings"
	@echo "make kernels      compile the kernels that tests and manual share, in the user's cache"
	@echo "make bench        speed and efficiency, against peers"
	@echo "make docs         the manual, in docs/_build/html; runs all of its code blocks"
	@echo "make docs-and-test  the manual beside the tests, without lint, as .ci/run does"
	@echo "make clean        remove what these made, the environment included"

install: $(STAMP)

runtime: | $(BIN)/python
	$(BIN)/python -m pip install --quiet $(PIP_OPTIONS) --editable .

# The pip that Python brings may be one that takes twice the time to choose among files.
$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet $(PIP_OPTIONS) --upgrade pip || true

$(STAMP): pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet $(PIP_OPTIONS) --editable ".[test,app,napari,lint,docs]"
	@touch $@

demo: $(STAMP)
	@mkdir -p $(DEMO)
	$(BIN)/iscat simulate --config $(DEMO_CONFIG) --out $(DEMO)/movie.tif --overwrite
	$(BIN)/iscat-fit $(DEMO)/movie.tif --config $(DEMO_CONFIG) --out $(DEMO)/movie.iscat --overwrite
	@echo "The report: $(DEMO)/movie.iscat/report.html"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python .ci/docstrings.py
	$(BIN)/python .ci/size.py --check

quick: $(STAMP)
	$(BIN)/python .ci/quick.py

kernels: $(KERNELS)

# Compiled once, while the style is judged, and not by every worker and every page.
$(KERNELS): $(STAMP) docs/kernel_cache.py $(wildcard iscat_analysis/_kernels/*.py)
	$(BIN)/python docs/kernel_cache.py
	@touch $@

lint-and-kernels: $(STAMP)
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target lint kernels

test: lint-and-kernels
	@$(MAKE) --no-print-directory tests

tests: $(STAMP)
	$(BIN)/$(PYTEST)

test-all: lint-and-kernels
	$(BIN)/$(PYTEST) --share=$(SHARE) --cov --cov-fail-under=90

# Old libraries may use what new ones deprecate, so that warnings are errors above but not here.
test-lowest: $(LOWEST)/.installed
	$(LOWEST)/bin/python -m $(PYTEST) -q -p no:cacheprovider tests \
	    --ignore=tests/app --ignore=tests/cli --ignore=tests/docs --ignore=tests/hardening --ignore=tests/viewer \
	    -W default::DeprecationWarning -W default::PendingDeprecationWarning -W default::FutureWarning

$(LOWEST)/.installed: pyproject.toml .ci/lowest.py
	$(PYTHON) -m venv --clear $(LOWEST)
	$(PYTHON) .ci/lowest.py test > $(LOWEST)/constraints.txt
	$(LOWEST)/bin/python -m pip install --quiet --prefer-binary \
	    --constraint $(LOWEST)/constraints.txt --editable ".[test]"
	@touch $@

bench: $(STAMP)
	$(BIN)/python benchmarks/run.py

docs: $(KERNELS)
	$(BIN)/sphinx-build --quiet -W --keep-going -b html docs docs/_build/html
	@echo "The manual: docs/_build/html/index.html"

docs-and-test: $(KERNELS)
	@$(MAKE) --no-print-directory --jobs=2 docs tests

clean:
	rm -rf $(VENV) $(DEMO) build dist docs/_build docs/reference/api *.egg-info .coverage* \
	    .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
