# The targets that a person runs are the ones that CI runs. `make help` lists them.
PYTHON ?= python3
ARGS ?=
YIELDING ?=
RUNS ?= 100000
HOURS ?= 1
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
RUNTIME := $(VENV)/.installed-runtime
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input
# All extras but docs and fuzz, which `make docs` and `make fuzz` install.
TOOLS := batch cluster compass dashboard demo foxglove mf4 raw rinex ros studies dev
COMPILE := CUSTOM_COMPILE_COMMAND="make lock" $(BIN)/pip-compile --quiet --strip-extras --allow-unsafe \
	--generate-hashes --all-build-deps --no-emit-index-url --no-emit-find-links \
	--no-emit-trusted-host --no-emit-options

# Modules are compiled once, whatever the caller's habit: an installation leaves the bytecode of what
# commands import, and the tests start hundreds of processes.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install demo test lint unit fuzz hil format picture bench faults wires pairs soak load attack man deb docs lock clean arm \
	dashboard-check kernels rewritten prebuilt systemd test-packages

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 10

install: $(STAMP) ## .venv for developers: locked dependencies, tools of the tests, fusiond (editable)

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and f"Python 3.11 or newer needed, this is {v[0]}.{v[1]}: make PYTHON=/path/to/python3.11")'
	@PYTHON="$(PYTHON)" tools/debian-packages.sh run
	@echo "creating $(VENV)"
	$(PYTHON) -m venv $(VENV)

# Of the packages little is ever imported: the bytecode of that is left by importing it once, 5 s of
# the processor's time and 21 MB (all of eight packages: 11 s, 49 MB; pip would compile every one). A
# container that writes none would compile it again at each start. The lock of the tools holds all of
# the other in the same versions, and leaves what is there alone.
$(RUNTIME): pyproject.toml requirements.lock | $(BIN)/python
	@echo "installing locked dependencies and fusiond into $(VENV)"
	$(PIP) install --quiet --no-compile --require-hashes -r requirements.lock
	$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/python -m tools.bytecode
	@touch $@

$(STAMP): requirements-dev.lock $(RUNTIME)
	@echo "installing the tools of developers into $(VENV)"
	$(PIP) install --quiet --no-compile --require-hashes -r requirements-dev.lock
	@touch $@

demo: $(RUNTIME) ## simulated vehicle, real daemon, dashboard; ARGS="--duration 60 --headless"
	$(BIN)/fusiond demo --dashboard $(ARGS)

# One core compiles while the other installs the tools, lints and rewrites assertions; then two at a
# time, in this order. Hardware in the loop waits for real time more than it computes: the others
# take what it leaves, and are the first to yield. The unit's guest comes after theirs: with them
# it would be four guests at once.
test: $(RUNTIME) ## everything that CI checks
	$(MAKE) --jobs=2 --output-sync=line lint rewritten hil unit systemd YIELDING="nice -n 19"

lint: $(STAMP) ## ruff, mypy, who may import whom and the picture of it
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(YIELDING) $(BIN)/mypy
	$(YIELDING) $(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/python tools/house.py --check
	$(BIN)/python -m tools.reader --check

prebuilt: $(RUNTIME) ## kernels for levels of processors, into the checkout, for a wheel that compiles nothing
	$(BIN)/python -m tools.prebuilt $(ARGS)

# The collector would look through what the compiler keeps again and again, a tenth of its time.
kernels: $(RUNTIME)
	@echo "compiling the kernels once, before the tests share them"
	$(BIN)/python -c 'import gc; gc.set_threshold(50000); \
	import fusiond.live.daemon, fusiond.offline.process, fusiond.simulation.live_devices, \
	fusiond.estimators.federated.no_reset, fusiond.estimators.multiscale.filter, \
	fusiond.estimators.unscented.filter'

# Beside the kernels, which it does not need: on a fresh clone each worker would do it, three times
# the same 8 s.
rewritten: $(STAMP)
	@echo "rewriting the tests' assertions once, before the workers share them"
	@$(YIELDING) $(BIN)/python -m pytest --noconftest -p tests.rewritten

# A file's tests stay on one core: they share what the first of them computed. Each core has its
# process, so that threads of the linear algebra would only fight for it; one process more works
# while others wait for brokers and devices, an eighth of the time.
unit: $(STAMP) rewritten kernels test-packages ## unit and property tests, on every core
	OPENBLAS_NUM_THREADS=1 $(YIELDING) $(BIN)/pytest -n $$(($$(nproc) + 1)) --dist loadfile --no-loadscope-reorder \
		--ignore tests/hil/test_hil.py $(ARGS)

fuzz: $(STAMP) ## every parser with atheris, side by side; RUNS=10000000 ARGS=nmea for one of them
	@$(BIN)/python -c 'import atheris' 2>/dev/null || $(PIP) install --quiet 'atheris>=3'
	$(BIN)/python -m tests.fuzz.run --runs $(RUNS) $(ARGS)

hil: $(STAMP) kernels test-packages ## hardware in the loop; alone, since the daemon keeps real time
	$(BIN)/pytest tests/hil/test_hil.py

systemd: $(STAMP) kernels test-packages | $(if $(YIELDING),hil) ## the unit as its README installs it, systemd as process 1 of a guest
	$(BIN)/python -m tests.hil.unit_guest

test-packages:
	@PYTHON="$(PYTHON)" tools/debian-packages.sh test

format: $(STAMP) ## let ruff lay out the code
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

picture: $(STAMP) ## docs/house.svg, from the imports
	$(BIN)/python tools/house.py

bench: $(STAMP) ## what the kernels cost; ARGS="--json F.json" keeps the figures
	$(BIN)/fusiond bench $(ARGS)

faults: $(STAMP) ## fault matrix as a table; ARGS="--only step_500m", "--service 3", "--sharpness 4"
	$(BIN)/python -m fusiond.studies.faults $(ARGS)

wires: $(STAMP) test-packages ## faults of wires, clocks and the host; ARGS="--only gnss_late_3s"
	$(BIN)/python benchmarks/wire_faults.py $(ARGS)

pairs: $(STAMP) ## every ordered pair of commands from an empty kernel cache
	$(BIN)/python -m tests.commands.pairs

soak: $(STAMP) test-packages ## the daemon for HOURS of real time, with faults now and then
	$(BIN)/python benchmarks/soak.py $(HOURS) $(ARGS)

load: $(STAMP) test-packages ## CPU and memory of the daemon under load, as JSON
	$(BIN)/python benchmarks/daemon_load.py $(ARGS)

attack: $(STAMP) test-packages ## the daemon while guests attack its servers; ARGS="--seconds 100 --rest 60 --only poll_1"
	$(BIN)/python benchmarks/attack.py $(ARGS)

dashboard-check: $(STAMP) ## the dashboard in Debian's Chromium beside the daemon; ARGS="--minutes 60"
	@PYTHON="$(PYTHON)" tools/debian-packages.sh look
	@$(BIN)/python -c 'import playwright' 2>/dev/null || $(PIP) install --quiet 'playwright>=1.49'
	$(BIN)/python -m benchmarks.map_check
	$(BIN)/python benchmarks/dashboard_check.py $(ARGS)

docs: $(RUNTIME) ## the documentation as a site in build/site, every link checked
	@$(BIN)/python -c 'import material' 2>/dev/null || $(PIP) install --quiet --no-build-isolation --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m tools.docs_site

man: $(RUNTIME) ## manual pages in build/man: fusiond(1), fusiond.toml(5)
	$(BIN)/python -m tools.man_pages

deb: $(RUNTIME) ## a Debian package in build/deb; ARGS="--python /usr/bin/python3"
	@PYTHON="$(PYTHON)" tools/debian-packages.sh deb
	$(BIN)/python -m tools.debian_package $(ARGS)

arm: $(RUNTIME) ## smoke test on aarch64, emulated: import, one kernel, a 10 s drive; ARGS="import kernel"
	@PYTHON="$(PYTHON)" tools/debian-packages.sh arm
	$(BIN)/python -m tools.arm $(ARGS)

lock: $(STAMP) ## both lock files anew from pyproject.toml; ARGS=--upgrade for newer versions
	$(COMPILE) $(TOOLS:%=--extra %) $(ARGS) --output-file requirements-dev.lock pyproject.toml
	cp requirements-dev.lock requirements.lock
	$(COMPILE) --extra dashboard --extra demo --extra raw --output-file requirements.lock pyproject.toml

golden: $(STAMP) ## what the kept recordings give now, into tests/golden; git diff shows what changed
	$(BIN)/python -m tests.golden.golden $(ARGS)

clean: ## remove what the other targets made
	rm -rf $(VENV) build dist *.egg-info .fuzz .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
