# `make demo` and `make test` set up everything they need in .venv, then do their job.
PYTHON ?= python3
BIN := .venv/bin
# Small arrays gain nothing from threads, and threads of several processes get in each other's way.
export OMP_NUM_THREADS ?= 1

.PHONY: demo test bench calibrations lint format clean

demo: .venv/ready
	$(BIN)/python examples/demo.py

test: .venv/ready lint
	$(BIN)/pytest -m "not slow" --numprocesses 2 --dist loadfile

bench: .venv/ready
	$(BIN)/python benchmarks/speed.py
	$(BIN)/python benchmarks/scale.py
	$(BIN)/python benchmarks/streaming.py
	$(BIN)/python benchmarks/learning.py

lint: .venv/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: .venv/ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "failuretwin needs Python 3.11 or newer: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv .mypy_cache .pytest_cache .ruff_cache .hypothesis

# The calibrations that come with the package; DATA is the folder of the published logs.
DATA ?= ../shared/data
CALIBRATIONS := src/failuretwin/digital_model/robots/calibrations
calibrations: .venv/ready
	cd $(DATA) && $(CURDIR)/$(BIN)/failuretwin calibrate real_robot_b_20241003/label_[0-4] \
		--name armpi_fpv --out $(CURDIR)/$(CALIBRATIONS)/armpi_fpv.toml
	cd $(DATA) && $(CURDIR)/$(BIN)/failuretwin calibrate healthy_logs/robot_b \
		--name armpi_fpv_b_2024-05 --out $(CURDIR)/$(CALIBRATIONS)/armpi_fpv_b_2024-05.toml
	cd $(DATA) && $(CURDIR)/$(BIN)/failuretwin calibrate healthy_logs/robot_a \
		--name armpi_fpv_a_2024 --out $(CURDIR)/$(CALIBRATIONS)/armpi_fpv_a_2024.toml
