# `make explore` runs an episode, `make test` what CI runs. Both install what they need into .venv first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OTHER_GYMNASIUM := 1.2.2
OTHER := $(VENV)/gymnasium-$(OTHER_GYMNASIUM)
RLLIB := $(VENV)/rllib
SEED ?= 0
OUT ?= out/explore
WORKERS ?= 2
AGENTS := nearest-frontier,cost-utility,next-best-view,rrt,tour,brisk-tour,active,explore-and-return,random,ppo-frontier,ppo
# A file's tests run in one process: two would compile its kernels at the same time.
TESTED := -n $(WORKERS) --dist loadfile --no-loadscope-reorder
# Seconds. A test that waits for ever fails by name and the others go on; the first ones may compile for minutes.
PATIENCE := 1200
API_TESTS := $(wildcard tests/mecanum_env/test_env*.py) tests/mecanum_env/vector

# The libraries' own threads only get in each other's way here: tests run in processes of their own.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export NUMBA_NUM_THREADS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# Each of the processes that tests start would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install explore test lint types pytest other-gymnasium package bounds rllib online monte-carlo evaluate benchmark docs speed clean

help: ## show this help
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "make %-16s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

# Python compiles what it imports, and most of what is installed is never imported: --no-compile.
# A stamp's file date says whether what it stands for is older than what it was made from.
$(VENV)/core.stamp: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e .
	@touch $@

$(VENV)/test.stamp: $(VENV)/core.stamp
	$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt -e '.[test,train,multi,human,video,ros,rerun,ray,parquet,docs,release]'
	@touch $@

$(OTHER).stamp: $(VENV)/test.stamp
	rm -rf $(OTHER)
	$(BIN)/python -m pip install --quiet --no-compile --no-deps --target $(OTHER) gymnasium==$(OTHER_GYMNASIUM)
	@touch $@

# RLlib pins the oldest Gymnasium, so it cannot share an environment with the newest: all other versions stay.
$(RLLIB).stamp: pyproject.toml constraints.txt
	test -x $(RLLIB)/bin/python || $(PYTHON) -m venv $(RLLIB)
	grep -v '^gymnasium==' constraints.txt > $(RLLIB)/constraints.txt
	$(RLLIB)/bin/python -m pip install --quiet --no-compile -c $(RLLIB)/constraints.txt -e '.[rllib,test]'
	@touch $@

install: $(VENV)/core.stamp ## install the core into .venv

explore: $(VENV)/core.stamp ## one episode: an unseen apartment, explored and mapped (SEED, OUT)
	$(BIN)/mecanum explore --agent ppo-frontier --rooms apartment --seed $(SEED) --out $(OUT)
	@echo
	@echo "Open $(OUT)/report.html in a browser: it replays the episode. Then try:"
	@echo "  make explore SEED=7                              another apartment"
	@echo "  $(BIN)/mecanum explore --rooms cave              another kind of room"
	@echo "  $(BIN)/mecanum explore --floor-plan office.yaml  a plan of your own: ROS map or image"
	@echo "  $(BIN)/mecanum --help                            all else"

# Kernels compile on one core while libraries are installed, and types checked, on the other.
test: ## everything CI checks (WORKERS)
	$(MAKE) --no-print-directory -j2 $(VENV)/kernels.stamp lint types
	$(MAKE) --no-print-directory pytest
	$(MAKE) --no-print-directory -j2 other-gymnasium package

# What an episode runs is compiled, and kept. Python looks for garbage less often meanwhile: 6 % less time.
$(VENV)/kernels.stamp: $(VENV)/core.stamp
	MECANUM_COMPILING=0 $(BIN)/python -c \
		"import gc, sys; gc.set_threshold(20_000, 20, 50); from training.cli import main; sys.exit(main())" \
		explore --agent ppo-frontier --max-steps 40 --out out/kernels > /dev/null
	@touch $@

lint: $(VENV)/test.stamp ## ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/test.stamp ## mypy
	$(BIN)/mypy

pytest: $(VENV)/test.stamp ## the tests
	$(BIN)/python -m pytest $(TESTED) --timeout $(PATIENCE)

# The oldest Gymnasium that is supported, laid over the other: RLlib pins it.
other-gymnasium: $(OTHER).stamp ## the Gymnasium API tests on the oldest version
	PYTHONPATH=$(CURDIR)/$(OTHER) $(BIN)/python -c \
		"import gymnasium; assert gymnasium.__version__ == '$(OTHER_GYMNASIUM)', gymnasium.__version__"
	PYTHONPATH=$(CURDIR)/$(OTHER) $(BIN)/python -m pytest $(TESTED) --timeout $(PATIENCE) $(API_TESTS)

# After the tests: it takes over the kernels that they have compiled.
package: $(VENV)/test.stamp ## the wheel: built, looked at, installed alone, and exploring
	$(BIN)/python -m pytest --timeout $(PATIENCE) -m release tests/test_release.py

# Compiled kernels look at no bounds: what lies outside of an array is read and written without a word.
bounds: $(VENV)/test.stamp ## the tests, in kernels that look at the bounds of arrays (not in CI: they are compiled anew)
	NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(CURDIR)/$(VENV)/bounds $(BIN)/python -m pytest $(TESTED) --timeout $(PATIENCE)

rllib: $(RLLIB).stamp ## the RLlib example, in an environment of its own (not in CI: large)
	$(RLLIB)/bin/python -m pytest tests/examples -k rllib

online: $(VENV)/test.stamp ## the tests of --wandb and hf://, offline all the same (not in CI: large)
	$(BIN)/python -m pip install --quiet --no-compile -e '.[hub,wandb]'
	$(BIN)/python -m pytest tests/agents/learned/test_hub.py tests/training/learning/test_follow.py

monte-carlo: $(VENV)/test.stamp ## the long statistical runs
	$(BIN)/python -m pytest $(TESTED) -m monte_carlo

evaluate: $(VENV)/core.stamp ## the table of docs/studies/estimators.md: 300 episodes on the test seeds
	$(BIN)/mecanum study accuracy --workers $(WORKERS) --out out/evaluate

benchmark: $(VENV)/core.stamp ## BENCHMARK.md: the agents above on every suite (an hour on two cores; goes on where it was broken off)
	$(BIN)/mecanum benchmark --suite all --agents $(AGENTS) --workers $(WORKERS) --out out/benchmark --report
	$(BIN)/mecanum study leaderboard out/benchmark BENCHMARK.md

docs: $(VENV)/test.stamp ## the documentation as a site, in out/site
	$(BIN)/python -m mkdocs build --strict --site-dir out/site

speed: $(VENV)/core.stamp ## steps per second, and where the time goes
	$(BIN)/mecanum speed

clean: ## remove .venv, results and caches
	rm -rf $(VENV) out build .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
	find slam mecanum_env agents training tests -name __pycache__ -type d -prune -exec rm -rf {} +
