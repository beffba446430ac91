# `make run` and `make test` install what they need: Python 3.11 to 3.13 with venv is enough; PYTHON=... selects it. `make run` installs the
# libraries of the default examination; every other target installs all libraries and the development tools.
VENV := .venv
BIN := $(VENV)/bin
PIP = $(BIN)/python -m pip install --disable-pip-version-check --progress-bar on -c constraints.txt
PYTHON ?= python3
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export PYTHONHASHSEED := 0
# Tests start hundreds of processes: modules are compiled once.
unexport PYTHONDONTWRITEBYTECODE
# Two processes share the tests; tests/conftest.py keeps related tests together.
TWO_WORKERS := -n 2 --dist loadfile --no-loadscope-reorder

.PHONY: run test test-slow test-docker test-browser lint format bench docs install venv clean

run: $(VENV)/.examines  ## the default examination, as processes on this machine
	$(BIN)/palpate run $(ARGS)

test: install  ## everything but the slow, Docker, browser and page tests; whole examinations (tests/test_gate*.py) too
	$(BIN)/python -m pytest -q -m "not slow and not docker and not browser and not pages" $(TWO_WORKERS)

test-slow: install  ## long cases: seeds, scenarios, faults
	$(BIN)/python -m pytest -q -m "slow"

test-docker: install  ## builds the images and runs a short examination on a Docker engine
	$(BIN)/python -m pytest -q -m "docker"

test-browser: install  ## opens the dashboard of live runs in headless Chromium
	@for name in chromium chromium-browser google-chrome google-chrome-stable; do command -v $$name >/dev/null && exit 0; done; \
	echo "test-browser: no Chromium on the PATH: THE BROWSER TESTS ARE SKIPPED"
	$(BIN)/python -m pytest -q -m "browser"

bench: install  ## figures with ratios, as a table and as bench.json
	$(BIN)/palpate bench

# The folders whose English is checked: docstrings, comments, messages and pages.
PLAIN := *.md .ci .github asv benchmarks bus compose dashboards docs fmus models palpate research services tests
lint: install  ## code, types, imports, pages and plain English
	$(BIN)/python -m pytest -q -m "pages" tests
	$(BIN)/codespell -D - -D .codespell-house-words.txt $$(git ls-files $(PLAIN) | grep -vE '\.(png|gif|csv|json|html|parquet|mcap)$$')
	$(BIN)/python tests/plain_english.py $(PLAIN)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: install  ## the site with its generated reference pages: out/site/index.html
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -r requirements-docs.txt
	$(BIN)/python docs/site.py out/site-pages
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build

install: $(VENV)/.installed

# A full installation includes the libraries of the default examination.
$(VENV)/.examines: pyproject.toml constraints.txt $(wildcard $(VENV)/.installed)
	@test -e $(VENV)/.installed || { $(MAKE) --no-print-directory venv && \
	echo "installing the libraries of an examination, about 1.5 GB; for the dashboard: $(BIN)/pip install 'palpate[dashboard]'" && \
	$(PIP) -e '.[run]'; }
	@touch $@

$(VENV)/.installed: pyproject.toml constraints.txt requirements-dev.txt
	@$(MAKE) --no-print-directory venv
	@echo "installing all implementations and the tools of the workspace, about 3.5 GB"
	@$(PIP) -r requirements-dev.txt -e '.[all]'
	@touch $@

venv:
	@test -x $(BIN)/python || $(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || \
	{ echo "Palpate needs Python 3.11, 3.12 or 3.13; $(PYTHON) is $$($(PYTHON) --version 2>&1). Name another: make PYTHON=python3.12"; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)

clean:
	rm -rf $(VENV) out
