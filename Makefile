# Two commands matter: `make demo` and `make test`. Both make the environment in .venv by themselves.
VENV ?= .venv
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11 python3.10; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1 && echo "$$p" && break; done)
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
# Empty it (make test ROS=) to leave out the tests over live topics and the wheels and messages they need.
ROS ?= 1

# How many tests run at a time. Those that measure time, marked `alone`, run after the others. What fails beside
# other tests is told and runs once more alone: a machine that stands still for seconds is no fault of rcseg.
WORKERS ?= 2
# How long `make fuzz` draws hostile inputs.
MINUTES ?= 10

.PHONY: demo test test-core check bench clean ready fuzz

demo: $(VENV)/.installed
	@$(BIN)/rcseg replay bags/arc2017 --output demo --overlays --force

test: $(VENV)/.tools
	@$(MAKE) --no-print-directory --jobs=2 ready
	@$(BIN)/python -m pytest -m "not alone" --numprocesses=$(WORKERS) --dist=loadfile || \
		{ echo "Once more, without others beside them: the tests that failed"; \
		$(BIN)/python -m pytest --last-failed --last-failed-no-failures=none; }
	$(BIN)/python -m pytest -m alone

test-core: $(VENV)/.tools
	$(BIN)/python -m pytest test/core test/oracle

# The kernels are compiled once, while the messages are built, and not by every worker.
ready: $(VENV)/.kernels $(if $(ROS),$(VENV)/.ros)

$(VENV)/.kernels: $(VENV)/.tools $(wildcard rcseg_core/*.py rcseg_core/*/*.py)
	@echo "Compiling the kernels (a minute or two, once)"
	@$(BIN)/rcseg warmup > $@.log || { cat $@.log >&2; exit 1; }
	@touch $@

check: $(VENV)/.checkers
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell

fuzz: $(VENV)/.tools
	$(BIN)/python benchmarks/fuzz.py --minutes $(MINUTES)

bench: $(VENV)/.installed
	@$(BIN)/rcseg bench

clean:
	rm -rf $(VENV) build install log demo *.egg-info rcseg_msgs/build rcseg_msgs/*.egg-info

$(VENV)/.made:
	@test -n "$(PYTHON)" || { echo "rcseg needs Python 3.10 or newer on the PATH (or: make PYTHON=/path/to/python3)" >&2; exit 2; }
	@echo "Making the environment in $(VENV) with $(PYTHON)"
	@$(PYTHON) -m venv $(VENV) || { echo "cannot make $(VENV): install the venv module of your Python (Debian, Ubuntu: apt install python3-venv)" >&2; rm -rf $(VENV); exit 2; }
	@touch $@

$(VENV)/.installed: $(VENV)/.made setup.py pyproject.toml
	@echo "Installing rcseg and what it needs into $(VENV) (a minute or two, once)"
	@$(PIP) --editable .
	@touch $@

$(VENV)/.tools: $(VENV)/.installed
	@echo "Installing the test tools into $(VENV)"
	@$(PIP) --editable '.[test]'
	@touch $@

$(VENV)/.checkers: $(VENV)/.tools
	@echo "Installing ruff, mypy and the other checkers into $(VENV)"
	@$(PIP) --editable '.[dev]'
	@touch $@

# rclpy and Fast DDS from wheels, and our messages built against them: no ROS on the machine is needed.
$(VENV)/.ros: $(VENV)/.tools $(wildcard rcseg_msgs/msg/*.msg rcseg_msgs/CMakeLists.txt rcseg_msgs/setup.py)
	@echo "Installing rclpy and building the messages into $(VENV) (about two minutes, once)"
	@$(PIP) --editable '.[ros,colcon]'
	@$(PIP) ./rcseg_msgs
	@touch $@
