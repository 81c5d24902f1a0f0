# Every target does its own set-up, in .venv, and does it again only when setup.py changes.
#
#   make run ARGS="--controller onoff --hours 1"     passes options on to bringup
#   make test ARGS="test/test_packaging.py -k pip"   ... to pytest
#   make clean; make PYTHON=python3.12 run           takes another Python, 3.10 or later

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=

# Without a ROS 2, pip brings one (the extra [ros]). One that is sourced is used as it is, through
# an environment that sees the packages outside; wheels on top of it would mix two ROS 2. Changing
# from one to the other makes .venv again. What is in .venv itself, be it active, is not sourced.
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
TEST_EXTRAS := [pump,mqtt,watch,foxglove,study,dask,test]
BENCH_EXTRAS := [study,bench]
DOCS_EXTRAS := [pump,mqtt,watch,foxglove,study,dask,docs]
else
VENV_OPTIONS :=
RUN_EXTRAS := [ros,pump,mqtt,watch,foxglove]
STUDY_EXTRAS := [study]
TEST_EXTRAS := [ros,pump,mqtt,watch,foxglove,study,dask,test]
BENCH_EXTRAS := [ros,study,bench]
DOCS_EXTRAS := [ros,pump,mqtt,watch,foxglove,study,dask,docs]
endif

# Stamp files: the environment was made; what a target needs was installed into it.
MADE := $(VENV)/.made-$(ROS)
FOR_RUN := $(VENV)/.for-run
FOR_STUDY := $(VENV)/.for-study
FOR_TEST := $(VENV)/.for-test
FOR_BENCH := $(VENV)/.for-bench
FOR_DOCS := $(VENV)/.for-docs

# It prints what it installs: the first time it takes a minute or two. Python compiles what is
# imported, which is a small part of it.
PIP_INSTALL = $(BIN)/python -m pip --disable-pip-version-check install --no-compile --editable

.PHONY: help run study test lint docs bench doc-commands faults test-kilted clean

help:
	@echo "make run    the 12 h of the paper with the predictive controller, as a node graph"
	@echo "make study  the 30 runs of the paper, and their report: no ROS"
	@echo "make test   every test"
	@echo "make test-kilted  the tests that start nodes, with the next ROS 2"
	@echo "make lint   ruff, mypy, which folder imports from which, spelling"
	@echo "make docs   the documentation, doc/_build/index.html"
	@echo "make bench  the speed of graph and controller, as ratios"
	@echo "make doc-commands  every block of commands in README and doc/, as written: half an hour"
	@echo "make faults every process, cable and message made to fail: half an hour"
	@echo "make clean  remove .venv and all else that can be made again; runs/ stays"

run: $(FOR_RUN)
	@$(BIN)/python -m greenroof_ros.bringup $(or $(ARGS),--controller mpc)

study: $(FOR_STUDY)
	@$(BIN)/python -m greenroof_ros study; code=$$?; \
	    $(BIN)/python -m greenroof_ros report studies/paper && exit $$code

# Without ARGS every test, four processes more than there are cores, since graphs mostly wait.
# Which tests may run side by side is in test/conftest.py. What failed runs once more, one at a
# time, and with pytest's explanations: a live site's limits are of real time, which a busy machine
# exceeds. What fails again, fails. Without pytest-xdist a test's name does not end in its group,
# and none may be left out.
FAILED := .pytest_cache/v/cache/lastfailed
test: $(FOR_TEST)
ifeq ($(ARGS),)
	@rm -f $(FAILED); $(BIN)/python -m pytest --numprocesses $$(($$(nproc) + 6)) --dist loadgroup \
	    --no-loadscope-reorder --assert=plain; code=$$?; [ $$code -eq 1 ] || exit $$code; \
	    echo "Once more, one at a time, what failed:"; \
	    sed -i 's/@[^]@"]*": true/": true/' $(FAILED); \
	    $(BIN)/python -m pytest --last-failed --last-failed-no-failures none --exitfirst && \
	    ! grep true $(FAILED)
else
	@$(BIN)/python -m pytest $(ARGS)
endif

# The next ROS 2, in an environment of its own: its wheels replace the wheels of the extra [ros].
KILTED := .venv-kilted
KILTED_WHEELS := "ros-kilted-rclpy[fastrtps]>=9.1,<10" $(addprefix ros-kilted-, \
    std-msgs rosgraph-msgs diagnostic-msgs rcl-interfaces std-srvs)

test-kilted: $(KILTED)/.made
	@$(KILTED)/bin/python -m pytest --numprocesses $$(($$(nproc) + 3)) --dist loadgroup -m graph $(ARGS)

$(KILTED)/.made: setup.py
	$(PYTHON) -m venv $(KILTED)
	$(KILTED)/bin/python -m pip --disable-pip-version-check install $(KILTED_WHEELS) \
	    --editable ".[pump,mqtt,watch,foxglove,study,dask,test]"
	@touch $@

lint: $(FOR_TEST)
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/codespell

# Its tables are made again first; a link that leads nowhere is an error.
docs: $(FOR_DOCS)
	@$(BIN)/python doc/generate.py
	@rm -rf doc/api/modules
	@$(BIN)/python -m sphinx -W --keep-going -q --fresh-env --jobs auto -b html doc doc/_build
	@echo "written: doc/_build/index.html"

bench: $(FOR_BENCH)
	@$(BIN)/python tools/bench.py

doc-commands: $(FOR_TEST)
	@GREENROOF_ROS_TEST_DOCS=1 $(BIN)/python -m pytest test/doc/test_commands.py -k as_written \
	    -v -rs -o timeout=14400 $(ARGS)

# Goes on where it was ended; when all is done, the table of the documentation is made again.
faults: $(FOR_TEST)
	@$(BIN)/python -m pytest tools/faults/campaign.py -q -rN -p no:cacheprovider -n 4 --dist loadgroup \
	    -o timeout=1200 $(ARGS)
ifeq ($(ARGS),)
	@$(BIN)/python tools/faults/table.py runs/faults doc/explanation/fault-campaign.md
endif

$(MADE):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
	    echo "Python 3.10 or later is needed; $(PYTHON) is $$($(PYTHON) --version 2>&1)." >&2; \
	    echo "Name another one: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "$(PYTHON) cannot make virtual environments; on Debian and Ubuntu:" >&2; \
	    echo "    apt-get install python3-venv" >&2; exit 1; }
	rm -rf $(VENV)
	$(PYTHON) -m venv $(VENV_OPTIONS) $(VENV)
ifeq ($(ROS),sourced)
	@$(BIN)/python -c 'import rclpy' || { \
	    echo "A ROS 2 is sourced, but $(PYTHON) cannot use its rclpy. Name the Python that it is" >&2; \
	    echo "for (make PYTHON=/usr/bin/python3 ...), or use a shell in which none is sourced." >&2; \
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
