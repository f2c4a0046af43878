# `make demo` and `make test` set up everything they need in .venv.
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do command -v $$p && break; done)
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -q
LONG := OMP_NUM_THREADS=1 nice -n 10 $(BIN)/flowlab bench --workers 1 --device cpu
unexport PYTHONDONTWRITEBYTECODE # images set it; each of the hundreds of processes would compile all that it imports

.PHONY: demo pictures test test-all openpi lerobot ray campaigns lint format house reference docs wheel benchmark table1 ablations clean help

help: ## this list
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

demo: .venv/run .venv/opengl ## a policy from nothing in minutes, and labels from pictures alone: demo/index.html
	rm -rf demo
	$(BIN)/python tools/demo

pictures: .venv/run .venv/opengl ## every picture of the documentation, anew; NAMES="hammer film" for these only
	$(BIN)/python tools/pictures $(NAMES)

test: .venv/test ## the tests, below 8 minutes on 2 cores
	$(BIN)/pytest -m "not slow" -n 3 --dist loadfile --no-loadscope-reorder

test-all: .venv/test ## the tests, and the slow ones: all 50 tasks, other tools' readers
	FLOWLAB_TESTS=all $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

openpi: .venv/test ## the real openpi-client drives a served policy, in an environment of its own
	test -d .venv-openpi || $(PYTHON) -m venv .venv-openpi
	.venv-openpi/bin/python -m pip --disable-pip-version-check -q install openpi-client==0.1.2 typing_extensions ./client # it imports the second without asking for it
	FLOWLAB_OPENPI=.venv-openpi/bin/python $(BIN)/pytest tests/serving/test_openpi_client.py

ray: .venv/test ## a Ray cluster of two machines makes a dataset, and one of them is killed; needs a machine that is not busy
	$(PIP) install -c constraints.txt ray
	FLOWLAB_RAY=1 $(BIN)/pytest tests/pipeline/test_ray_engine.py

lerobot: .venv/test ## LeRobot's own class opens what is exported, in an environment of its own: Python 3.12, 5.2 GB
	test -d .venv-lerobot || python3.12 -m venv .venv-lerobot
	.venv-lerobot/bin/python -m pip --disable-pip-version-check -q install --no-cache-dir 'lerobot[dataset]==0.6.1'
	FLOWLAB_LEROBOT=$(CURDIR)/.venv-lerobot/bin/python $(BIN)/pytest -s tests/storage/test_lerobot_client.py

CAMPAIGN ?= --budget 1200
campaigns: .venv/test ## kill, flip, fuzz, attack, disk: hours; see docs/reliability.md. CAMPAIGN="--seed 7 --count 50"
	@failed=; for name in kill flip fuzz attack disk; do \
	  $(BIN)/python -m tests.campaigns.$$name $(CAMPAIGN) || failed="$$failed $$name"; done; \
	test -z "$$failed" || { echo "findings in:$$failed; see campaigns/"; exit 1; }

lint: .venv/lint ## format, style, types, import contracts, spelling
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell

format: .venv/lint ## format the code and mend what can be mended
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

house: .venv/run ## figures of the code: lengths, circles, names, docstrings, spelling
	$(BIN)/python tests/house/house.py

reference: .venv/run ## write docs/commands.md and docs/settings.md, from the code
	$(BIN)/python tools/reference

docs: .venv/docs ## the documentation, into site/; warnings are errors
	$(BIN)/zensical build --clean --strict

wheel: .venv/build ## build the wheel and try it in an environment of its own
	rm -rf dist && $(BIN)/python -m build -q --wheel
	rm -rf .venv-wheel && $(PYTHON) -m venv .venv-wheel
	.venv-wheel/bin/python -m pip --disable-pip-version-check -q install -c constraints.txt dist/*.whl
	cd dist && ../.venv-wheel/bin/python ../tests/smoke.py
	rm -rf .venv-wheel

benchmark: .venv/benchmark ## ours against what a user would do otherwise
	$(BIN)/python benchmarks/extract.py

table1: .venv/run ## the paper's Table I on one core, from where docs/results/table1 is; says what is left
	$(LONG) --recipe table1 --out docs/results/table1

ablations: .venv/run ## the paper's Tables II and III and its learning curves, likewise
	$(LONG) --recipe ablations --out docs/results/ablations

clean: ## remove environments and everything made by the targets above
	rm -rf .venv .venv-lerobot .venv-openpi .venv-wheel demo pictures dist site

.venv/run: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) install -c constraints.txt pip
	$(PIP) install --no-compile -c constraints.txt -e . # what is used is compiled when it is first imported
	@touch $@

# Simulated cameras see color through OpenGL. As root on Debian it is installed; else `flowlab grade` says what to do.
.venv/opengl: .venv/run
	@if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && ! ldconfig -p | grep -q libEGL_mesa; then \
	  echo "installing OpenGL (libegl1 libgl1-mesa-dri)"; \
	  (apt-get update && apt-get install -y --no-install-recommends libegl1 libgl1-mesa-dri) >/dev/null 2>&1 || true; fi
	@touch $@

.venv/%: .venv/run
	$(PIP) install -c constraints.txt --group $*
	@touch $@
