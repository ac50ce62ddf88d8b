PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/installed
LOCKED := $(BIN)/pip install --quiet $(PIP_OPTIONS) --require-hashes --no-deps
OPTIONAL := ^(pybullet|pyrealsense2|ray|rerun-sdk|rosbags|ur-rtde|onnx|onnxscript)==

# `make quick`: these files without their slow tests, under 45 seconds on two idle cores.
QUICK := actions arm checkpoint cli dataset features geometry golden lever_up meshes objects predictor solids splits \
	statistics surface topdown trajectories windows

.PHONY: setup lock wheels audit licences dist demo test quick check bench figures checkpoint docs clean

setup: $(STAMP)

# Every package is the file that requirements.lock names by its checksum; torch alone is another file on machines with
# and without a GPU, and its version is in constraints.txt. The lines of OPTIONAL packages wait: some have no wheels for
# some machines. PIP_OPTIONS is what pip is told besides.
$(STAMP): pyproject.toml requirements.lock constraints.txt
	test -d .venv || $(PYTHON) -m venv .venv
	grep -vE '$(OPTIONAL)' requirements.lock > .venv/packages.txt
	$(LOCKED) -r .venv/packages.txt
	$(BIN)/pip install --quiet $(PIP_OPTIONS) --constraint constraints.txt torch
	$(BIN)/pip install --quiet --no-deps --no-build-isolation --editable .
	grep -E '$(OPTIONAL)' requirements.lock | while read -r line; do \
		echo "$$line" > .venv/package.txt; \
		$(LOCKED) --only-binary :all: -r .venv/package.txt \
			|| echo "no $${line%% *} for this Python: its tests are skipped"; \
	done
	touch $(STAMP)

# After a change of the dependencies; versions that fit stay as they are. The lines of packages that torch brings on
# machines with a GPU are left out, and those of the extra `warp`, which runs there.
lock:
	$(BIN)/pip install --quiet uv
	$(BIN)/uv pip compile pyproject.toml --all-extras --universal --python-version 3.11.0 --generate-hashes \
		--constraint constraints.txt --no-emit-package torch --no-annotate --no-header --quiet \
		--output-file requirements.lock
	sed -i -e ':join' -e '/\\$$/{N;s/ *\\\n */ /;bjoin}' requirements.lock
	sed -i -E '/^(nvidia|cuda|triton|mujoco-warp|warp-lang|etils|zipp)-?/d' requirements.lock

# Which pinned packages have no wheel for macOS or Windows.
wheels: setup
	$(BIN)/pip install --quiet uv
	$(BIN)/python .ci/wheels.py

audit: setup
	test -d .venv/audit || $(PYTHON) -m venv .venv/audit
	.venv/audit/bin/pip install --quiet pip-audit
	.venv/audit/bin/python .ci/audit.py

licences: setup
	$(BIN)/python .ci/licences.py > docs/results/licences.md

# What a release consists of, checked as a package host would. URL is the address below which the repository's files are
# served: README's links and pictures then work in the description, too.
dist: setup
	test -d .venv/dist || $(PYTHON) -m venv .venv/dist
	.venv/dist/bin/pip install --quiet build twine
	rm -rf dist
	FORETRACE_URL=$(URL) .venv/dist/bin/python -m build --outdir dist > dist.log 2>&1 || { cat dist.log; exit 1; }
	rm dist.log
	.venv/dist/bin/twine check --strict dist/*
	ls -l dist

demo: setup
	$(BIN)/foretrace demo --out demo

test: setup
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal

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
	$(BIN)/foretrace evaluate paper --out docs/results/paper --twins docs/results/twin docs/results/residual --redraw

# The predictor that comes with the package: an hour of simulation on one core, and half an hour of training. Its regions
# are calibrated on lever-ups of other objects.
checkpoint: setup
	$(BIN)/foretrace simulate --recipe all --randomise --exact-share 0.5 --vary-action --off-centre --camera grid \
		--embodiment tool --objects 4000 --seed 3 --out data/default
	$(BIN)/foretrace train --data data/default --predictor one-shot --heights --hidden 192 --components 64 --epochs 60 \
		--phase-time --error-weighting 0.5 --hidden-share 0.6 --context friction tool_friction density contact_error \
		bevel_width bevel_height insertion arc_radius sweep speed \
		--outcomes levered slipped tumbled rolled missed --split 39300 1200 700 --threads 1 --out runs/default --card
	$(BIN)/foretrace simulate --recipe all --randomise --exact-share 0.5 --vary-action --off-centre --camera grid \
		--embodiment tool --objects 300 --seed 4 --out data/calibration
	$(BIN)/foretrace recalibrate --run runs/default --data data/calibration
	rm -f runs/default/model.onnx
	$(BIN)/foretrace export onnx runs/default --out runs/default/model.onnx
	cp runs/default/config.json runs/default/model.safetensors runs/default/model.onnx runs/default/MODEL_CARD.md \
		src/foretrace/predictor/default

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

clean:
	rm -rf demo site build dist
