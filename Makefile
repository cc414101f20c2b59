# `make help` lists the targets. Needs make and Python ≥ 3.11; everything else goes into .venv.
#   ARGS="…"     options for what the target starts: make virtual ARGS="--duration 10 --headless --json"
#   PYTHON=…     interpreter to make .venv with, where the first one found is not the one wanted
#   PNEUD=…      of install-service: the installed command, such as /opt/pneud/bin/pneud, in the place of .venv's

VENV := .venv
BIN := $(VENV)/bin
RUNTIME := $(VENV)/.runtime
DEV := $(VENV)/.dev
MUTATION := $(VENV)/.mutation
DOCS := $(VENV)/.docs
DEBIAN_PYTHON := /usr/bin/python3
# The tests that reach every branch of safety/ and control/.
COVERING := $(addprefix tests/test_,control_*.py safety_*.py $(addsuffix .py,axis_faults axis_parts asking homing laws \
  cause load_cell pressing probing profiles program program_axis reference reload adaptation standstill))
PYTHONS := $(or $(PYTHON),python3.13 python3.12 python3.11 python3)

.DEFAULT_GOAL := help
.PHONY: help virtual test lint types contracts ci-tests slow-tests realtime-tests coverage mutation mutants lowest vm systemd install-service docs pages pictures campaign campaign-vm devices devices-vm device-faults canopen-starts information truths many-runs strange soak clean

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(firstword $(MAKEFILE_LIST)) | expand -t 17

virtual: $(RUNTIME) ## close the loop on the software rig
	@exec $(BIN)/pneud --virtual $(ARGS)

install-service: $(if $(PNEUD),,$(RUNTIME)) ## the systemd units of the installed pneud; DESTDIR= writes them below a folder
	@exec $(or $(PNEUD),$(BIN)/pneud) install-service $(if $(DESTDIR),--destdir '$(DESTDIR)') $(ARGS)

# Each has tests that are neighbours, so that what those share is made once, until it takes some of the other's.
# One worker more than there are processors: many tests wait for time to pass.
WORKERS := -n $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1) --dist worksteal
# Tests start many processes: each would compile all over again where the environment forbids to keep that.
test slow-tests realtime-tests coverage lowest: export PYTHONDONTWRITEBYTECODE :=

test: $(DEV) ## the quick tests
	@exec $(BIN)/python -m pytest $(WORKERS) $(ARGS)

lint: $(DEV) ## ruff: rules and layout
	@$(BIN)/ruff check .; rules=$$?; $(BIN)/ruff format --check . && exit $$rules

types: $(DEV) ## mypy --strict
	@exec $(BIN)/mypy

contracts: $(DEV) ## who may import whom
	@exec $(BIN)/lint-imports --no-logo

ci-tests: ## the tests that take longer: both that follow
	@$(MAKE) --no-print-directory slow-tests; others=$$?; $(MAKE) --no-print-directory realtime-tests && exit $$others

slow-tests: $(DEV) ## those that company does not disturb
	@exec $(BIN)/python -m pytest $(WORKERS) -m 'slow and not realtime' $(ARGS)

realtime-tests: $(DEV) ## those that have the machine for themselves
	@exec $(BIN)/python -m pytest -m 'slow and realtime' $(ARGS)

coverage: $(DEV) ## every branch of safety/ and control/ is taken by a test of theirs
	@$(BIN)/python -m pytest -q $(WORKERS) $(COVERING) --cov=src/pneud/safety --cov=src/pneud/control --cov-branch \
	    --cov-report=term-missing:skip-covered --cov-fail-under=100 $(ARGS) || \
	  { echo 'coverage: a test failed, or src/pneud/safety and src/pneud/control are not covered to the last branch' >&2; exit 1; }

mutation: $(MUTATION) ## what of safety/ can be changed without a test that fails (minutes)
	@exec .ci/mutation $(ARGS)

mutants: $(MUTATION) ## the same of 300 places in bus/, console/, daemon/, log/ and loop/ (most of an hour)
	@exec nice $(BIN)/python -m hil.mutants $(ARGS)

# What safety/ and control/ compute, no library has a part in.
lowest: $(DEV) ## the quick tests with the lowest versions of all that pneud says it works with
	@exec .ci/lowest $(addprefix --ignore ,$(wildcard $(COVERING))) $(ARGS)

vm: $(DEV) ## the tests over real SocketCAN, in a virtual machine (see hil/README.md)
	@exec hil/vm/run -t 600 -- $(BIN)/python -m pytest -m vm -p no:cacheprovider tests/vm $(ARGS)

systemd: $(DEV) ## the service under systemd, in a virtual machine, from the wheel
	@rm -rf build/wheels
	@$(BIN)/python -m hatchling build -t wheel -d build/wheels >/dev/null
	@$(BIN)/python -m pip --python $(DEBIAN_PYTHON) wheel --quiet --disable-pip-version-check -w build/wheels build/wheels/*.whl
	@exec hil/vm/run -s -t 560 -- $(CURDIR)/$(BIN)/python -m pytest -m systemd -p no:cacheprovider tests/vm/test_service.py $(ARGS)

docs: $(DOCS) ## the documents as a site: build/site/index.html; nothing in it is fetched from elsewhere
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict -d build/site $(ARGS)
	@echo 'build/site/index.html, or with its search: $(BIN)/python -m http.server -d build/site'

pages: $(DEV) ## what of the documents is made from the code, made anew
	@PYTHONPATH=docs exec $(BIN)/python -m generators.pages

pictures: $(DEV) ## the pictures in the documents, taken anew; needs Chromium
	@PYTHONPATH=docs exec $(BIN)/python -m generators.pictures

campaign: $(DEV) ## fault scenarios in real time: build/campaign/matrix.html (see docs/hil.md)
	@exec $(BIN)/python hil/campaign.py --bus unixcan -o build/campaign $(ARGS)

campaign-vm: $(DEV) ## the same over real SocketCAN, in a virtual machine
	@mkdir -p build/campaign-vm
	@exec hil/vm/run -t 2400 -w build/campaign-vm -- $(BIN)/python hil/campaign.py --bus vcan0 -o build/campaign-vm $(ARGS)

devices: $(DEV) ## the axis on rigs of other people's devices (see docs/hil.md)
	@exec $(BIN)/python -m hil.devices $(ARGS)

devices-vm: $(DEV) ## the same over real SocketCAN, in a virtual machine
	@exec hil/vm/run -t 900 -- $(BIN)/python -m hil.devices --bus vcan0 $(ARGS)

device-faults: $(DEV) ## the fault scenarios on them, in simulated time (minutes; see docs/hil.md)
	@exec $(BIN)/python -m hil.device_faults $(ARGS)

canopen-starts: $(DEV) ## starts of a CANopen rig whose nodes misbehave, in real time (see docs/hil.md)
	@exec $(BIN)/python -m hil.canopen_starts $(ARGS)

information: $(DEV) ## what late, lost and odd frames do to the command, in simulated time (see docs/hil.md)
	@exec $(BIN)/python -m hil.information $(ARGS)

truths: $(DEV) ## hidden truths, commissioned in simulated time: twelve, a minute each (see hil/README.md)
	@exec $(BIN)/python -m hil.truths $(ARGS)

many-runs: $(DEV) ## a campaign by one process, by two, by Dask, and with all of them killed (see docs/campaigns.md)
	@exec $(BIN)/python -m hil.many_runs $(ARGS)

strange: $(DEV) ## the axis on rigs that are not as it believes, in real time (see hil/README.md)
	@exec $(BIN)/python -m hil.strange $(ARGS)

soak: $(DEV) ## the tests that take hours, with their figures (see docs/hil.md)
	@exec $(BIN)/python -m pytest -m soak $(ARGS)

clean: ## remove the environment and everything made
	rm -rf $(VENV) build dist mutants .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache .coverage
	find src tests hil -name __pycache__ -type d -prune -exec rm -rf {} +

# True: .venv works and holds this checkout. False: it was moved or copied, its scripts name another folder.
SOUND := $(shell $(BIN)/python -c 'import os, pneud; print(os.path.samefile(pneud.__path__[0], "src/pneud"))' 2>/dev/null)
ifneq ($(SOUND),True)
.PHONY: $(RUNTIME) $(DEV) $(MUTATION) $(DOCS)
endif

# Makes the environment where there is no usable one, then installs $(1). All words go to stderr: the standard
# output of `make virtual` belongs to pneud.
define environment
@exec >&2; \
fits() { "$$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }; \
has_uv() { command -v uv >/dev/null; }; \
fail() { echo "pneud: $$1" >&2; exit 1; }; \
if [ "$(SOUND)" = False ] || ! fits $(BIN)/python || ! { has_uv || $(BIN)/python -c 'import pip' 2>/dev/null; }; then \
  found=; old=; bare=; \
  for python in $(PYTHONS); do \
    if ! fits "$$python"; then old=$${old:-$$("$$python" --version 2>/dev/null)}; \
    elif ! has_uv && ! "$$python" -c 'import ensurepip, venv' 2>/dev/null; then bare=$${bare:-$$python}; \
    else found=$$python; break; fi; \
  done; \
  [ -n "$$found$$bare" ] || \
    fail "needs Python 3.11 or newer, found $${old:-none}: install one, or name it: make PYTHON=/path/to/python3.11 …"; \
  [ -n "$$found" ] || \
    fail "$$bare cannot make environments: apt install python3-venv (Debian, Ubuntu), or install uv"; \
  echo "Making $(VENV) with $$("$$found" --version) (once)"; \
  rm -rf $(VENV); trap 'rm -rf $(VENV); exit 1' INT TERM; \
  if has_uv; then uv venv --quiet --python "$$found" $(VENV); else "$$found" -m venv $(VENV); fi || \
    { rm -rf $(VENV); fail "$$found could not make $(VENV) (see above)"; }; \
  trap - INT TERM; \
fi; \
if has_uv; then uv pip install --quiet --python $(BIN)/python -e $(1); \
else $(BIN)/python -m pip install --quiet --disable-pip-version-check -e $(1); fi || \
  fail "packages could not be installed (see above); this needs a package index once"; \
$(BIN)/python -m compileall -q src || : # uncompiled modules, where Python may not or shall not write them, cost at every start
endef

$(RUNTIME): pyproject.toml
	$(call environment,.)
	@touch $@

$(DEV): pyproject.toml
	$(call environment,'.[dev$(comma)sim]')
	@touch $(RUNTIME) $@

$(MUTATION): pyproject.toml
	$(call environment,'.[dev$(comma)sim$(comma)mutation]')
	@touch $(RUNTIME) $(DEV) $@

$(DOCS): pyproject.toml
	$(call environment,'.[dev$(comma)sim$(comma)docs]')
	@touch $(RUNTIME) $(DEV) $@

comma := ,
