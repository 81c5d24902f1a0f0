# Every target sets itself up in .venv, and does so again only when setup.py changes.
#
#   make run ARGS="--controller onoff --hours 1"     passes options on to bringup
#   make test ARGS="test/test_packaging.py -k pip"   passes options on to pytest
#   make clean; make PYTHON=python3.12 run           uses another Python, 3.11 or later

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=

# If no ROS 2 is sourced, pip installs one (the extra [ros]). A ROS 2 that is sourced is used as it
# is, through an environment that sees the packages outside it; wheels on top of it would mix two
# versions of ROS 2. A change from one to the other creates .venv again. A ROS 2 in .venv itself
# does not count as sourced, even if .venv is active.
ifdef AMENT_PREFIX_PATH
ROS := $(shell $(PYTHON) -c 'import importlib.util as u; s = u.find_spec("rclpy"); \
    print("sourced" if s and not s.origin.startswith("$(CURDIR)/$(VENV)/") else "wheels")')
else
ROS := wheels
endif
ifeq ($(ROS),sourced)
VENV_OPTIONS := --system-site-packages
RUN_EXTRAS := [pump,mqtt,watch,foxglove]
STUDY_EXTRAS := [study]
TEST_EXTRAS := [pump,mqtt,watch,foxglove,study,test]
BENCH_EXTRAS := [study,gym,bench]
DOCS_EXTRAS := [pump,mqtt,watch,foxglove,study,docs]
else
VENV_OPTIONS :=
RUN_EXTRAS := [ros,pump,mqtt,watch,foxglove]
STUDY_EXTRAS := [study]
TEST_EXTRAS := [ros,pump,mqtt,watch,foxglove,study,test]
BENCH_EXTRAS := [ros,study,gym,bench]
DOCS_EXTRAS := [ros,pump,mqtt,watch,foxglove,study,docs]
endif

# Stamp files: the environment exists, and everything that a target needs is installed in it.
MADE := $(VENV)/.made-$(ROS)
FOR_RUN := $(VENV)/.for-run
FOR_STUDY := $(VENV)/.for-study
FOR_TEST := $(VENV)/.for-test
FOR_BENCH := $(VENV)/.for-bench
FOR_DOCS := $(VENV)/.for-docs

# It prints what it installs, because the first time takes a minute or two. Python later compiles
# the modules that are imported, which are only a small part.
PIP_INSTALL = $(BIN)/python -m pip --disable-pip-version-check install --no-compile --editable

.PHONY: help run study test lint docs bench doc-commands faults test-kilted clean

help:
	@echo "make run           run the paper's 12 h with the predictive controller as a node graph"
	@echo "make study         run the paper's 30 runs and write their report, without ROS"
	@echo "make test          run all tests"
	@echo "make test-kilted   run the tests that start nodes with the next ROS 2"
	@echo "make lint          check style, types, imports between folders and spelling"
	@echo "make docs          build the documentation, doc/_build/index.html"
	@echo "make bench         measure the speed of the graph and the controller, as ratios"
	@echo "make doc-commands  run every block of commands in README and doc/ as written (half an hour)"
	@echo "make faults        make every process, cable and message fail (half an hour)"
	@echo "make clean         remove .venv and everything else that can be made again, but not runs/"

run: $(FOR_RUN)
	@$(BIN)/python -m greenroof_ros.bringup $(or $(ARGS),--controller mpc)

study: $(FOR_STUDY)
	@$(BIN)/python -m greenroof_ros study; code=$$?; \
	    $(BIN)/python -m greenroof_ros report studies/paper && exit $$code

# Without ARGS, this runs every test in six more processes than there are cores, since graphs
# mostly wait. test/conftest.py decides which tests may run side by side.
test: $(FOR_TEST)
	@$(BIN)/python -m pytest $(or $(ARGS),--numprocesses $$(($$(nproc) + 6)) --dist loadgroup \
	    --no-loadscope-reorder)

# The next ROS 2 is in an environment of its own, where its wheels replace those of the extra [ros].
KILTED := .venv-kilted
KILTED_WHEELS := "ros-kilted-rclpy[fastrtps]>=9.1,<10" $(addprefix ros-kilted-, \
    std-msgs rosgraph-msgs diagnostic-msgs rcl-interfaces std-srvs)

test-kilted: $(KILTED)/.made
	@$(KILTED)/bin/python -m pytest --numprocesses $$(($$(nproc) + 3)) --dist loadgroup -m graph $(ARGS)

$(KILTED)/.made: setup.py
	$(PYTHON) -m venv $(KILTED)
	$(KILTED)/bin/python -m pip --disable-pip-version-check install $(KILTED_WHEELS) \
	    --editable ".[pump,mqtt,watch,foxglove,study,test]"
	@touch $@

lint: $(FOR_TEST)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/codespell

# This first generates the tables again. A broken link is an error.
docs: $(FOR_DOCS)
	@$(BIN)/python doc/generate.py
	@rm -rf doc/api/modules
	@$(BIN)/python -m sphinx -W --keep-going -q --fresh-env --jobs auto -b html doc doc/_build
	@echo "written: doc/_build/index.html"

# BESIDE=DIR compares this checkout with another one.
bench: $(FOR_BENCH)
ifeq ($(BESIDE),)
	@$(BIN)/python tools/bench.py
else
	@$(BIN)/python tools/beside.py $(BESIDE)
endif

doc-commands: $(FOR_TEST)
	@GREENROOF_ROS_TEST_DOCS=1 $(BIN)/python -m pytest test/doc/test_commands.py -k as_written \
	    -v -rs -o timeout=14400 $(ARGS)

# This continues where it was stopped. At the end it generates the documentation's table again.
faults: $(FOR_TEST)
	@$(BIN)/python -m pytest tools/faults/campaign.py -q -rN -p no:cacheprovider -n 4 --dist loadgroup \
	    -o timeout=1200 $(ARGS)
ifeq ($(ARGS),)
	@$(BIN)/python tools/faults/table.py runs/faults doc/explanation/fault-campaign.md
endif

$(MADE):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "Python 3.11 or later is needed; $(PYTHON) is $$($(PYTHON) --version 2>&1)." >&2; \
	    echo "Choose another one: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "$(PYTHON) cannot make virtual environments; on Debian and Ubuntu:" >&2; \
	    echo "    apt-get install python3-venv" >&2; exit 1; }
	rm -rf $(VENV)
	$(PYTHON) -m venv $(VENV_OPTIONS) $(VENV)
ifeq ($(ROS),sourced)
	@$(BIN)/python -c 'import rclpy' || { \
	    echo "A ROS 2 is sourced, but $(PYTHON) cannot use its rclpy. Choose the Python for which" >&2; \
	    echo "it was built (make PYTHON=/usr/bin/python3 ...), or use a shell without it." >&2; \
	    rm -rf $(VENV); exit 1; }
endif
	@touch $@

$(FOR_RUN): $(MADE) setup.py
	$(PIP_INSTALL) '.$(RUN_EXTRAS)'
	@touch $@

$(FOR_STUDY): $(MADE) setup.py
	$(PIP_INSTALL) '.$(STUDY_EXTRAS)'
	@touch $@

$(FOR_TEST): $(MADE) setup.py
	$(PIP_INSTALL) '.$(TEST_EXTRAS)'
	@touch $(FOR_RUN) $(FOR_STUDY) $@

$(FOR_BENCH): $(MADE) setup.py
	$(PIP_INSTALL) '.$(BENCH_EXTRAS)'
	@touch $(FOR_RUN) $(FOR_STUDY) $@

$(FOR_DOCS): $(MADE) setup.py
	$(PIP_INSTALL) '.$(DOCS_EXTRAS)'
	@touch $(FOR_RUN) $(FOR_STUDY) $@

clean:
	rm -rf $(VENV) $(KILTED) build dist install log *.egg-info doc/_build doc/api/modules
	rm -rf .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
