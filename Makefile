# `make run` and `make test` do all the set-up they need: Python 3.11 with venv is enough. PYTHON=... says which, if not the quickest.
VENV := .venv
BIN := $(VENV)/bin
PACKAGES := bus models fmus/abdomen $(patsubst %/pyproject.toml,%,$(wildcard services/*/pyproject.toml)) dashboards
MYPY_TARGETS := $(wildcard bus/palpate_* models/palpate_* fmus/abdomen/palpate_* services/*/palpate_* dashboards/palpate_*)
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export PYTHONHASHSEED := 0

.PHONY: run test test-slow test-docker test-browser test-all lint format bench docs install clean

run: install  ## the default examination, as processes on this machine
	$(BIN)/palpate run $(ARGS)

test: install  ## everything but the slow, Docker and browser tests
	$(BIN)/python -m pytest -q -m "not slow and not docker and not browser"

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

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	for target in $(MYPY_TARGETS); do $(BIN)/mypy $$target || exit 1; done
	$(BIN)/lint-imports

format: install
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: install  ## docs/topics.md, from the contract
	$(BIN)/python -m palpate_bus.doc

install: $(VENV)/.installed

# All local packages in one command, so that none of their names is ever looked up in a public registry.
$(VENV)/.installed: constraints.txt requirements-dev.txt $(addsuffix /pyproject.toml,$(PACKAGES))
	test -x $(BIN)/python || { python=$${PYTHON:-$$(tools/quickest-python)} && echo "Python: $$python" \
	&& "$$python" -c 'import sys; sys.exit(0 if sys.version_info[:2] == (3, 11) else "Palpate needs Python 3.11; set PYTHON=...")' \
	&& "$$python" -m venv $(VENV); }
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -r requirements-dev.txt $(addprefix -e ./,$(PACKAGES))
	touch $@

clean:
	rm -rf $(VENV) out
