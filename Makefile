PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/installed

# `make quick`: these files without their slow tests, under 45 seconds on two idle cores.
QUICK := actions arm checkpoint cli dataset features geometry golden lever_up meshes objects predictor solids splits \
	statistics surface topdown trajectories windows

.PHONY: setup demo test quick check bench figures checkpoint docs clean

setup: $(STAMP)

# The CPU build of torch is pinned in constraints.txt; unpinned it would bring several GB of CUDA.
$(STAMP): pyproject.toml constraints.txt
	test -d .venv || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt torch
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev,docs,video]'
	for package in pybullet pyrealsense2 rerun-sdk rosbags ur_rtde onnx onnxruntime onnxscript; do \
		$(BIN)/pip install --quiet --constraint constraints.txt --only-binary :all: $$package \
			|| echo "no $$package for this Python: its tests are skipped"; \
	done
	touch $(STAMP)

demo: setup
	$(BIN)/foretrace demo --out demo

test: setup
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal --ignore tests/test_realsense.py
	$(BIN)/python -m pytest tests/test_realsense.py  # its library has died once beside other tests

quick: setup
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal -m "not slow" $(QUICK:%=tests/test_%.py)

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: setup
	for name in simulate agreement training; do echo "== $$name"; $(BIN)/python benchmarks/$$name.py || exit 1; done

figures: setup
	$(BIN)/foretrace evaluate paper --out docs/results/paper --redraw

# The predictor that comes with the package: some 20 minutes on two cores.
checkpoint: setup
	$(BIN)/foretrace simulate --recipe everyday --randomise --objects 800 --seed 3 --out data/default
	$(BIN)/foretrace train --data data/default --predictor one-shot --heights --hidden 192 --components 64 --epochs 100 \
		--outcomes levered slipped tumbled rolled missed --split 6400 600 560 --threads 1 --out runs/default --card
	cp runs/default/config.json runs/default/model.safetensors runs/default/MODEL_CARD.md \
		src/foretrace/predictor/default

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

clean:
	rm -rf demo site build dist
