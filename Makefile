# `make` prints what there is to make. What is built lies in .venv; `make clean` removes it.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

VENV ?= .venv
# The first Python in the supported range; say `make PYTHON=/path/to/python3 ...` to choose another.
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python3.10; do \
    $$p -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null && echo $$p && break; done)
# The wheels of ROS 2 are for CPython 3.10 to 3.13 on Linux and x86-64. Elsewhere `.venv` has none: the
# tests of nodes are skipped, library and offline command are all there.
ROS = $(shell $(PYTHON) -c 'import platform, sys; print("[ros]" if sys.version_info < (3, 14) \
    and (sys.platform, platform.machine()) == ("linux", "x86_64") else "")')

BIN := $(abspath $(VENV))/bin
# What runs, with the nodes; what the tests need besides; what the docs need besides.
STAMP := $(VENV)/.installed
TEST_STAMP := $(VENV)/.installed-test
DOCS_STAMP := $(VENV)/.installed-docs
# Python compiles a module when it is first imported: most of what is installed never is.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

# Message setters check their types only when asked to before the first import. One thread for each
# process: the tests run side by side. Logs stay inside the environment.
TEST_ENV := ROS_PYTHON_CHECK_FIELDS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
    ROS_LOG_DIR=$(abspath $(VENV))/log
JOBS ?= auto
# Real nodes wait more than they work, but some of the tests bound their answers in time.
SYSTEM_JOBS ?= 2
# Neighbours in a file stay together, for they share what was simulated and tracked; who is done takes from others.
SHARED := --dist worksteal

# A kernel type of OpenBLAS to test under, e.g. Prescott, Haswell or SkylakeX; empty: the one that
# OpenBLAS chooses. `python test/helpers/kernel_types.py` lists those that this processor can run.
CORETYPE ?=
ifneq ($(CORETYPE),)
TEST_ENV += OPENBLAS_CORETYPE=$(CORETYPE)
endif

# What to test, e.g. TESTS='test/estimation test/acoustics'; empty: everything.
TESTS ?=
# Which parts of `make reliability`, empty for all, where they go, and how much of each (1: 40 minutes).
PARTS ?=
SHARE ?= 1
RELIABILITY ?= $(abspath $(VENV))/reliability
# Hostile messages of `make fuzz` for each system.
CASES ?= 100000
FUZZ_JSON ?=
# Damaged files of each format, and damaged or forged states of each system.
FILES ?= 100
STATES ?= 25000
# Tests that run the compiled kernels.
KERNEL_TESTS := test/estimation/test_set_particles.py test/acoustics/test_laplace.py test/trackers

# The environment stands alone: a sourced ROS 2 would mix its libraries with those of the wheels. And
# Python keeps what it has compiled of the sources: else each process compiles them anew, for seconds.
unexport AMENT_PREFIX_PATH LD_LIBRARY_PATH PYTHONPATH PYTHONDONTWRITEBYTECODE

.NOTPARALLEL:
.PHONY: help venv demo test test-core test-statistics test-bounds test-system fuzz reliability lint generate docs dist placeholders bench clean

help: ## print this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-13s %s\n", $$1, $$2}' Makefile

venv: $(TEST_STAMP) ## build .venv from PyPI, ROS 2 included (PYTHON=... chooses the interpreter)

$(STAMP): setup.py pyproject.toml
	@test -n '$(PYTHON)' || { echo 'sonar_imm needs Python 3.10 or newer and found none: install' \
	    'one or say make PYTHON=/path/to/python3' >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	    echo '$(PYTHON) is older than Python 3.10: say make PYTHON=/path/to/python3' >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo '$(PYTHON) lacks the module' \
	    'venv: on Debian and Ubuntu, sudo apt install python3-venv' >&2; exit 1; }
	@echo 'Building $(VENV) with '"$$($(PYTHON) --version)"'; the first time takes a minute or two.'
	@$(PYTHON) -m venv $(VENV)
	@$(INSTALL) --editable .
	@# Kernels compile while pip fetches the rest; whoever needs one earlier compiles it too.
	@nohup nice $(BIN)/sonar-imm warm >$(VENV)/warm.log 2>&1 &
	@# By its name: it is there, and need not be built again for what else it needs.
	@$(INSTALL) 'sonar_imm$(ROS)'
	@touch $@

$(TEST_STAMP): $(STAMP)
	@$(INSTALL) 'sonar_imm[test,lint,cluster]'
	@touch $@

demo: $(STAMP) ## play shipped bags to the live nodes, track all offline, say what they saw, write a report
	$(BIN)/sonar-imm demo --out demo

# Both parts at once: nodes wait half of their time, and what only computes is nice to them. What the system tests print
# comes in one piece at the end. Ctrl-C ends both.
test: venv ## run the tests; of the Monte Carlo ones an eighth, in turn
	@log=$$(mktemp); trap 'rm -f "$$log"' EXIT; code=0; set -m; \
	$(MAKE) --no-print-directory test-system >"$$log" 2>&1 & system=$$!; \
	nice -n 5 $(MAKE) --no-print-directory test-core & core=$$!; set +m; \
	trap 'kill -INT -- -$$core -$$system; wait; cat "$$log"; exit 130' INT TERM HUP; \
	wait $$core || code=$$?; wait $$system || code=$$?; cat "$$log"; exit $$code

test-core: venv ## run the tests that need no processes of their own (JOBS=... CORETYPE=... TESTS=...)
	$(TEST_ENV) $(BIN)/python -m pytest -m 'not system' --statistics share -n $(JOBS) $(SHARED) $(TESTS)

test-statistics: venv ## run every Monte Carlo test; `make test` takes an eighth of them in turn
	$(TEST_ENV) $(BIN)/python -m pytest -m statistics -n $(JOBS) $(SHARED) $(TESTS)

test-bounds: venv ## run the tests of the compiled kernels with every index checked
	$(TEST_ENV) NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR=$(abspath $(VENV))/numba-bounds \
	    $(BIN)/python -m pytest -m 'not system' --statistics none -n $(JOBS) $(SHARED) $(or $(TESTS),$(KERNEL_TESTS))

fuzz: venv ## send 100,000 hostile messages to each tracker, damage files and 100,000 states (CASES=... FILES=... STATES=... FUZZ_JSON=...)
	cd test && $(TEST_ENV) PYTHONPATH=.. $(BIN)/python -m helpers.hostile --cases $(CASES) --files $(FILES) --states $(STATES) \
	    $(if $(FUZZ_JSON),--json $(abspath $(FUZZ_JSON)))

# A node that compiles answers late: kernels first. The pages of tutorials take longest: they come before the rest, so that
# nothing waits for them at the end.
test-system: venv ## run the tests that start real nodes, two at a time (SYSTEM_JOBS=...)
	$(BIN)/sonar-imm warm
	$(TEST_ENV) $(BIN)/python -m pytest -m system -n $(SYSTEM_JOBS) $(SHARED) test/system/test_tutorials.py test/system

reliability: venv ## 40 minutes: all that may go wrong, and its page; goes on where it was broken off (SHARE=4 PARTS='soak flood' RELIABILITY=folder)
	code=0; CASES=$(CASES) SONAR_IMM_SHARE=$(SHARE) $(TEST_ENV) $(BIN)/python -m benchmarks.reliability $(RELIABILITY) \
	    --run $(PARTS) || code=$$?; $(BIN)/python docs/generate.py; exit $$code

lint: venv ## check the style with ruff and the types with mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

generate: venv ## write config/, docs/parameters/ and docs/results/*.md anew from code and results
	$(BIN)/python docs/generate.py

docs: generate $(DOCS_STAMP) ## the same, and build the pages of docs/ with the reference into site/
	$(TEST_ENV) NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo 'Open site/index.html.'

docs-version: export SITE_VERSIONS = 1
docs-version: docs ## the same site in pages/VERSION, beside those of earlier versions
	@$(BIN)/python .ci/versioned_site.py site pages "$$($(BIN)/python -c 'import sonar_imm; print(sonar_imm.__version__)')"

dist: venv ## build wheel and sdist into dist/, check them and their size
	@$(INSTALL) build twine
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
	@$(BIN)/python .ci/check_dist.py dist

placeholders: ## say what only the owner of a release can fill in (address, repository)
	@$(PYTHON) .ci/placeholders.py

$(DOCS_STAMP): $(STAMP)
	@$(INSTALL) 'sonar_imm[docs]'
	@touch $@

bench: venv ## measure the speed against other libraries
	$(BIN)/sonar-imm bench

clean: ## remove everything that was built
	@if test -e $(VENV)/pyvenv.cfg; then rm -rf $(VENV); fi
	rm -rf build install log dist demo site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
