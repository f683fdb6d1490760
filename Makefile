# Thin: what is worth testing lives in the package. `make help` lists the targets.
SHELL := /bin/sh
.DEFAULT_GOAL := help

PYTHON ?=                                   # an interpreter, 3.10 to 3.12; empty: the first suitable one
ARGS ?=                                     # more flags for `make train` or pytest
TRAIN_ARGS = --algo crc --env dmc_pixels/cartpole-swingup-v0 --conf-file zoo_configs/laptop.yml --progress \
	--eval-freq 625 --eval-episodes 5 --checkpoint-every 1000 --vec-env subproc --verbose 0 -f logs $(ARGS)
TORCH_CPU_INDEX := https://download.pytorch.org/whl/cpu
# Two test processes share two cores: more threads each would only wait for one another.
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1
EVERYTHING := .[zoo,video,track,analysis,cluster,onnx,bench,docs,dev]
STAMP := .venv/.installed-$(shell cat pyproject.toml constraints.txt | cksum | tr ' ' '-')

.PHONY: help train test test-slow test-long test-lowest reproduce-quick results docs bench coverage format lint type dist constraints doctor clean install rendering

help: ## list the targets
	@sed -n 's/^\([a-z-]*\):.*## /\1|/p' $(MAKEFILE_LIST) | while IFS='|' read -r name text; do \
	  printf '  make %-12s %s\n' "$$name" "$$text"; done

# `set -m`: Ctrl-C reaches the training alone, not make, which would end with an error of its own.
train: rendering ## train CRC-RL on cartpole-swingup from pixels; more flags: make train ARGS="--seed 1"
	@set -m 2>/dev/null; .venv/bin/python train.py $(TRAIN_ARGS); status=$$?; \
	case $$status in 130|143) ;; *) exit $$status ;; esac # stopped by a signal, and saved: no failure

test: rendering ## the fast tests, a few minutes on two cores
	@$(ONE_THREAD) .venv/bin/python -m pytest -n 2 --dist worksteal -m "not slow and not long" $(ARGS)

test-slow: rendering ## the slow tests: real environments, real training runs
	@$(ONE_THREAD) .venv/bin/python -m pytest -n 2 --dist worksteal -m "slow and not alone" $(ARGS) || [ $$? -eq 5 ] # 5: none
	@.venv/bin/python -m pytest -m "slow and alone" $(ARGS) || [ $$? -eq 5 ]

test-long: rendering ## the tests that take hours
	@.venv/bin/python -m pytest -m long $(ARGS) || [ $$? -eq 5 ]

test-lowest: rendering ## the fast tests with the lowest allowed versions of all but torch, in .venv-lowest
	.venv/bin/python -m venv --clear .venv-lowest
	.venv/bin/uv pip compile -q -p .venv-lowest --resolution lowest-direct --all-extras pyproject.toml -o .venv-lowest/versions.txt
	.venv-lowest/bin/python -m pip install -q --disable-pip-version-check -c .venv-lowest/versions.txt -e '$(EVERYTHING)'
	@$(ONE_THREAD) .venv-lowest/bin/python -m pytest -n 2 --dist worksteal -m "not slow and not long" $(ARGS)

coverage: rendering ## the lines of sb3_crc/ that the fast tests run; fails below 90 %
	@$(ONE_THREAD) .venv/bin/python -m pytest -n 2 --dist worksteal -m "not slow and not long" --cov $(ARGS)

reproduce-quick: rendering ## one row of docs/results.md anew, 70 minutes on two idle cores, and compare
	@.venv/bin/python -m sb3_crc compare --task cartpole-swingup --presets crc --seeds 1 --first-seed 21 --eval-every 20000 \
	  --conf-file zoo_configs/laptop.yml -o reproduction --jobs 1 $(ARGS)
	@.venv/bin/python -m sb3_crc reproduced reproduction results/laptop/final

results: $(STAMP) ## docs/results.md from the raw files in results/
	@.venv/bin/python -m sb3_crc results results/laptop/final --baseline crc --baseline rad \
	  --landmarks results/landmarks.json --trials results/laptop/trials.csv --trials results/laptop/final.csv -o docs/results.md

docs: $(STAMP) ## the documentation site, docs/_build/html/index.html; needs no network
	@.venv/bin/python -m sphinx -W --keep-going -q -b html -c docs . docs/_build/html

bench: rendering ## speed and memory beside peers, two hours on two idle cores; one alone: make bench ARGS=update
	@.venv/bin/python -m benchmarks $(or $(ARGS),all)

format: $(STAMP) ## put the code in order
	.venv/bin/ruff check --fix .
	.venv/bin/ruff format .

type: $(STAMP) ## types alone
	.venv/bin/mypy --strict sb3_crc

dist: $(STAMP) ## wheel and sdist in dist/, the same bytes wherever they are built
	.venv/bin/python -m build --no-isolation

lint: $(STAMP) ## style, types, import contracts, docstrings
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy --strict sb3_crc
	.venv/bin/lint-imports
	.venv/bin/interrogate sb3_crc

constraints: ## solve the exact versions anew
	$(VENV)
	@test -x .venv/bin/uv || .venv/bin/python -m pip install --disable-pip-version-check uv
	.venv/bin/uv pip compile --universal --python-version 3.10 --all-extras pyproject.toml \
	  --custom-compile-command "make constraints" -o constraints.txt

doctor: $(STAMP) ## show what works on this machine
	@.venv/bin/python -m sb3_crc doctor

clean: ## remove .venv, caches and build output; logs stay
	rm -rf .venv .venv-lowest build dist docs/_build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

install: $(STAMP) ## the virtual environment alone

rendering: $(STAMP)
	@.venv/bin/python -m sb3_crc rendering --install

define VENV
@.venv/bin/python -m pip --version >/dev/null 2>&1 || { \
	  for python in $(or $(strip $(PYTHON)),python3 python3.12 python3.11 python3.10); do \
	    if "$$python" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 13))' >/dev/null 2>&1; then \
	      echo "making .venv with $$python"; exec "$$python" -m venv --clear .venv; fi; \
	  done; echo "No Python 3.10 to 3.12 found: install one, or say make PYTHON=/path/to/python." >&2; exit 1; }
endef

# The stamp's name holds a checksum of what was installed, and it is written last: an interrupted installation has none.
# On Linux x86-64 without a GPU the PyTorch index saves about 3 GB of CUDA libraries, if it answers within 3 seconds.
$(STAMP):
	@rm -f .venv/.installed-*
	$(VENV)
	@index=; \
	if [ "$$(uname -sm)" = "Linux x86_64" ] && ! nvidia-smi >/dev/null 2>&1 && timeout 3 .venv/bin/python -c \
	  'from urllib.request import urlopen; urlopen("$(TORCH_CPU_INDEX)/torch/", timeout=3)' >/dev/null 2>&1; \
	then index="--extra-index-url $(TORCH_CPU_INDEX)"; fi; \
	exec .venv/bin/python -m pip install --disable-pip-version-check $$index -c constraints.txt -e '$(EVERYTHING)'
	@touch $@
