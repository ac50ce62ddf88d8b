PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/installed

.PHONY: setup demo test check bench docs figures clean

setup: $(STAMP)

# The CPU build of torch is pinned in constraints.txt; unpinned it would bring several GB of CUDA.
$(STAMP): pyproject.toml constraints.txt
	test -d .venv || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt torch
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev,docs,video]'
	touch $(STAMP)

demo: setup
	$(BIN)/foretrace demo --out demo

test: setup
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: setup
	for file in benchmarks/*.py; do echo "== $$file"; $(BIN)/python $$file || exit 1; done

docs: setup
	$(BIN)/mkdocs build --strict --quiet

figures: setup
	$(BIN)/python docs/results/draw.py

clean:
	rm -rf demo site build dist
