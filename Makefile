# `make` alone says what there is. Everything lives in .venv; nothing else on the machine is touched.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup demo test coverage check weights clean

VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
READY_DEV := $(VENV)/.ready-dev
MESSAGES := msg_defs/pyproject.toml msg_defs/CMakeLists.txt $(wildcard msg_defs/msg/*.msg msg_defs/srv/*.srv msg_defs/action/*.action)
INSTALL := $(BIN)/uv pip install --compile-bytecode --python $(BIN)/python $(if $(ROS_DISTRO),,./msg_defs)

help:  ## Say what each target does
	@echo "stmpl: real-time soft-tissue contact for robots"
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## (.*)/  make \1\t\2/' | expand -t 16

setup: $(READY)  ## Make .venv with Python 3.12, ROS 2 and what the main job needs (once; needs a C++ compiler)

demo: $(READY)  ## Run the main job: a robot massages a forearm over ROS 2, recorded, compared with FEM, with film and report
	$(BIN)/stmpl demo

test: export NUMBA_NUM_THREADS = 1  # two processes have two cores; threads of their own would wait for each other
test: $(READY_DEV)  ## Pass the tests, two at a time; print the slowest
	$(BIN)/python -m tests.warm  # kernels are there before two processes ask: what each compiles rounds otherwise in the last bits
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(TESTS)

coverage: TESTS = --cov --cov-report=
coverage: export COVERAGE_CORE = sysmon
coverage: test  ## Pass the tests, and print the files of which they run least
	@$(BIN)/coverage report | sed -n '1,12p;$$p'

check: $(READY_DEV)  ## Lint, types and the one-way import rule
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

weights: $(READY_DEV)  ## Make the networks that ship, from nothing: data, training (hours: data of pressures 56 minutes on two cores, training 67 on one; goes on if stopped)
	$(BIN)/stmpl generate --preset default --out data/default
	$(BIN)/stmpl train --preset default --data data/default --out stmpl_core/weights
	$(BIN)/stmpl generate --preset contacts --out data/contacts --start benchmarks/contacts_v1.npz
	$(BIN)/stmpl train --preset contacts --data data/contacts --out stmpl_core/weights
	$(BIN)/stmpl generate --preset tissue --out data/tissue --start benchmarks/limbs_v3.npz benchmarks/deep_v2.npz benchmarks/stout_v1.npz benchmarks/trunk_v1.npz benchmarks/thin_v1.npz --flat benchmarks/rounds_v2.npz
	$(BIN)/stmpl train --preset tissue --data data/tissue --out stmpl_core/weights
	$(BIN)/stmpl train --preset paper-reduced --data data/default --out stmpl_core/weights

clean:  ## Remove .venv, caches and build folders; runs/ stays
	rm -rf $(VENV) build install log *.egg-info .pytest_cache .ruff_cache .import_linter_cache .numba_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# On a ROS machine its own rclpy and colcon-built messages are used; elsewhere both come as wheels, for Python 3.12 only.
$(READY): setup.py pyproject.toml $(MESSAGES)
	@[ -n "$$ROS_DISTRO" ] || command -v c++ >/dev/null || { echo "stmpl needs a C++ compiler to build its ROS messages; on Ubuntu: sudo apt install g++"; exit 1; }
	@python=$$(.ci/find_python) || exit 1; \
	[ -x $(BIN)/python ] || $$python -m venv $${ROS_DISTRO:+--system-site-packages} $(VENV)
	$(BIN)/python -m pip install --quiet uv
	$(INSTALL) --editable ".[sim]"
	@touch $@

$(READY_DEV): $(READY)  # tools of the tests, and what all verbs need (gigabytes: torch)
	$(INSTALL) --editable ".[dev]"
	@touch $@
