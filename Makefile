# Needs Python 3.11 or newer with venv, and make; everything else is installed into .venv.

PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

# pip settings that would install elsewhere, or not at all; those of the network stay.
unexport PIP_USER PIP_TARGET PIP_PREFIX PIP_ROOT PIP_NO_DEPS PIP_DRY_RUN PIP_REQUIRE_HASHES PIP_NO_BUILD_ISOLATION
unexport PIP_IGNORE_INSTALLED PIP_PYTHON PIP_REPORT PYTHONPATH PYTHONHOME

.PHONY: help demo test test-lowest hunt mutants lint types bench docs site truth golden pictures clean
.DELETE_ON_ERROR:

help:
	@echo "make demo     install into .venv and calibrate the simulated sample"
	@echo "make test     run the tests"
	@echo "make site     build the documentation site into site/"
	@echo "make test-lowest  run the tests with the lowest versions that pyproject.toml states"
	@echo "make hunt     write one table in 10 000 ways and look for misreadings; COUNT=100000 for more"
	@echo "make mutants  break the optimizers in 200 ways and look whether the tests notice; COUNT=1000 for more"
	@echo "make lint     ruff"
	@echo "make types    mypy"
	@echo "make bench    run the benchmarks; ARGS=optimizers only those of the optimizers"
	@echo "make truth    is a good result good? traps, coverage, weights, robust losses, verification: hours"
	@echo "make docs     write the tables and outputs in the documentation anew"
	@echo "make golden   write the frozen outputs of the commands anew"
	@echo "make pictures draw the pictures of README and documentation anew"
	@echo "make clean    remove what make made"

demo: $(VENV)/installed
	$(BIN)/accelcal calibrate docs/sample.csv --g 9.80665

test: $(VENV)/installed-test
	$(BIN)/python -m pytest -n auto $(ARGS)

hunt: $(VENV)/installed-test
	$(BIN)/python tests/hunt.py $(or $(COUNT),10000)

mutants: $(VENV)/installed-test
	$(BIN)/python tests/mutants.py $(or $(COUNT),200)

lint: $(VENV)/installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/installed-lint
	$(BIN)/mypy

bench: $(VENV)/installed-bench
	$(BIN)/python -m benchmarks $(ARGS)

truth: $(VENV)/installed-bench
	$(BIN)/python -m benchmarks.truth --all --write docs/explanation/trust.md $(ARGS)

docs: $(VENV)/installed-test
	$(BIN)/python tests/test_docs.py

golden: $(VENV)/installed-test
	ACCELCAL_GOLDEN=renew $(BIN)/python -m pytest tests/journeys/test_golden.py

pictures: $(VENV)/installed-test
	$(BIN)/python tests/test_docs.py pictures
	$(BIN)/python tests/pictures.py

site: $(VENV)/installed-site
	NO_MKDOCS_2_WARNING=1 DISABLE_MKDOCS_2_WARNING=true $(BIN)/mkdocs build --strict --quiet --site-dir site
	@echo "site/index.html"

LOWEST := .venv-lowest
test-lowest: pyproject.toml tests/lowest.py
	$(PYTHON) -m venv $(LOWEST)
	$(PYTHON) tests/lowest.py > $(LOWEST)/constraints.txt
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check --editable ".[test]" --constraint $(LOWEST)/constraints.txt
	$(LOWEST)/bin/python -m pytest -n auto $(ARGS)

$(VENV)/created:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed; name it with make PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/installed: pyproject.toml | $(VENV)/created
	$(PIP) --editable .
	@touch $@

$(VENV)/installed-%: pyproject.toml | $(VENV)/created
	$(PIP) --editable ".[$*]"
	@touch $@ $(VENV)/installed

clean:
	rm -rf $(VENV) $(LOWEST) site build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find accelcal_cli tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
