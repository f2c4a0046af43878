# `make demo` and `make test` set up everything they need in .venv.
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3; do command -v $$p && break; done)
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -q
TASKS := hammer push drawer-open door-open
WORKSPACE := {low: [-0.5, 0.25, -0.2], high: [0.5, 0.97, 0.8]}

.PHONY: demo demo-real test test-all lint format docs wheel benchmark clean help

help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/'

demo: .venv/run ## real simulation to a picture, and to a policy that is tried; then an episode recorded, labeled from pictures, graded
	$(BIN)/flowlab extract-sim $(TASKS) --episodes 3 --set write.depth=true --out demo/data
	$(BIN)/flowlab validate demo/data
	$(BIN)/flowlab viz demo/data --task hammer --png demo/hammer.png --save demo/hammer.rrd
	@echo "The picture is demo/hammer.png; open the recording with: $(BIN)/rerun demo/hammer.rrd"
	rm -rf demo/run
	$(BIN)/flowlab train demo/data --policy fdp --minutes 1 --out demo/run
	$(BIN)/flowlab eval demo/run --episodes 2 --seeds 0 --out demo/report
	$(BIN)/flowlab viz demo/run --task hammer --png demo/predicted.png --save demo/predicted.rrd
	@echo "How often the policy succeeds: demo/report/report.html; the motion it foresees: demo/predicted.png"
	@$(MAKE) --no-print-directory demo-real

demo-real: .venv/run .venv/opengl ## the second half of the demo: what a camera would have seen, labeled blind
	$(BIN)/flowlab grade --tasks hammer --tracker rigid-bodies --tracker lucas-kanade --out demo/graded
	$(BIN)/flowlab track-real demo/graded/recordings --set observer.crop="$(WORKSPACE)" --out demo/real
	$(BIN)/flowlab validate demo/real
	$(BIN)/flowlab viz demo/real --png demo/real.png --save demo/real.rrd --mp4 demo/real.mp4
	@echo "How good the labels are: demo/graded/grade.png; what they look like: demo/real.mp4, demo/real.png, demo/real.rrd"

test: .venv/test ## the tests, below 8 minutes on 2 cores
	$(BIN)/pytest -m "not slow" -n 2 --dist loadfile

test-all: .venv/test ## the tests, and the slow ones: all 50 tasks, other tools' readers
	$(BIN)/pytest -n 2 --dist loadfile

lint: .venv/lint ## format, style, types, import contracts, spelling
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell

format: .venv/lint ## format the code and mend what can be mended
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

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

clean: ## remove environments and everything made by the targets above
	rm -rf .venv .venv-wheel demo dist site

.venv/run: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) install -c constraints.txt pip
	$(PIP) install -c constraints.txt -e .
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
