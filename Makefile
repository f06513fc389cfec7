# Everything works from a bare clone: `make run`, `make test`. Both set up .venv first.

PYTHON ?= python3
BIN := .venv/bin
PIP := PIP_CONSTRAINT=constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install -qq

.PHONY: run test check coverage mutation format faults bench clean

run: .venv/run ## reach three targets on the twin
	$(BIN)/robotctl run --backend sim

test: check coverage ## everything that must pass
	$(BIN)/python -m pytest -q -n 2 -m "not realtime" --ignore=tests/safety
	$(BIN)/python -m pytest -q -m realtime

coverage: .venv/dev ## every branch of safety/ is taken by its own tests
	$(BIN)/python -m coverage run --source=safety -m pytest -q tests/safety
	$(BIN)/python -m coverage report --show-missing --skip-covered --fail-under=100

mutation: .venv/dev ## every small mistake in safety/ is noticed by its own tests
	$(BIN)/python -m tests.mutation

check: .venv/dev ## format, lint, types
	$(BIN)/ruff format --check --diff .
	$(BIN)/ruff check .
	$(BIN)/mypy

format: .venv/dev ## write the format and the fixes that ruff can make
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

faults: .venv/run ## provoke every protection on every robot and backend, and write docs/safety-report.md
	status=0; \
	for arm in "panda sim" "panda can" "openarm sim" "openarm can" "kinova sim" "xarm7 sim"; do \
		set -- $$arm; $(BIN)/robotctl faults --robot $$1 --backend $$2 --report docs/safety-report.md || status=1; \
	done; exit $$status

bench: .venv/run ## what a tick costs beside the bare library calls
	$(BIN)/robotctl bench tick

clean:
	rm -rf .venv build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/run: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) -e .
	touch $@

.venv/dev: pyproject.toml constraints.txt | .venv/bin/python
	$(PIP) -e .[dev]
	touch $@ .venv/run
