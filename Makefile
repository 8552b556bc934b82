# `make reproduce` and `make test` work on a fresh machine with Python 3.11 or newer and nothing else:
# they make a virtual environment in .venv and install what they need there.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: reproduce test lint api gates benchmarks clean

reproduce: .venv/installed
	$(BIN)/lodestone reproduce

test: .venv/installed
	$(BIN)/python -m pytest -n 2

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

api: .venv/installed
	$(BIN)/python docs/api.py out/api

gates: .venv/installed
	$(BIN)/python -m pytest -n 2 -m "slow or not slow"

benchmarks: .venv/installed
	$(BIN)/python -m pip install -c constraints.txt -e '.[benchmarks]'
	$(BIN)/python benchmarks/environment.py
	$(BIN)/python benchmarks/tabular.py
	$(BIN)/python benchmarks/hierarchies.py
	$(BIN)/python benchmarks/training.py
	$(BIN)/python benchmarks/hosts.py
	$(BIN)/python benchmarks/checkpointing.py

# The stamp is newer than what it was installed from, so a change of dependencies installs again.
.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("Lodestone needs Python 3.11 or newer; run: make PYTHON=python3.11 ..." if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf .venv out
