# Each target sets up what it needs in .venv, and no more, then does its job.
PYTHON ?= python3
BIN := .venv/bin
# Small arrays gain nothing from threads, and threads of several processes get in each other's way.
export OMP_NUM_THREADS ?= 1
# Hundreds of processes of the tests import the package: it is compiled once, not by each.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo fleet test docs links notebooks pages wheel bench calibrations lint format clean

demo: .venv/demo
	$(BIN)/python examples/demo.py

# Three processes for two cores: some tests wait for servers and browsers.
test: .venv/ready lint
	@$(BIN)/python -c "import failuretwin as ft; ft.diagnose(ft.sample_log())"  # compiles the engine once
	$(BIN)/pytest -m "not slow" --numprocesses 3 --dist loadfile

# A server, 100 emulated robots and two workers on this computer, until Ctrl-C.
fleet: .venv/fleet
	$(BIN)/python examples/fleet/start.py

# The site is build/site/index.html. Warnings are errors, links between pages among them.
docs: .venv/docs
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet -b html docs build/site
	@echo "the site: build/site/index.html"

# Links to other sites, which need a network.
links: .venv/docs
	$(BIN)/sphinx-build --quiet -b linkcheck docs build/links

# Runs the pages, writes into them what their code prints now, and draws what is drawn from code.
pages: .venv/ready
	$(BIN)/python docs/executed.py docs/store.md docs/tutorials/*.md docs/contributing/*.md docs/reference/*.md
	$(BIN)/python docs/diagram.py
	$(BIN)/python docs/notebooks.py

# Every notebook, as Jupyter runs it.
notebooks: .venv/ready
	$(BIN)/pytest -n 0 tests/test_pages.py -k notebook

# Source archive and wheel, looked at, then tried by a Python that has nothing else.
wheel: .venv/release
	rm -rf dist build/wheel
	$(BIN)/python -m build
	$(BIN)/twine check --strict dist/*
	$(PYTHON) -m venv build/wheel
	build/wheel/bin/pip install --constraint constraints.txt dist/*.whl
	cd build && wheel/bin/failuretwin demo

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

.venv/made:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "failuretwin needs Python 3.11 or newer: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv .venv
	touch $@

.venv/demo: EXTRA := plots
.venv/demo: SIZE := 0.5 GB on disk, a minute or two
.venv/fleet: EXTRA := fleet,physics,store
.venv/fleet: SIZE := 0.7 GB on disk, a minute or two
.venv/docs: EXTRA := docs
.venv/docs: SIZE := 0.7 GB on disk, a minute or two
.venv/release: EXTRA := release
.venv/release: SIZE := 0.5 GB on disk, a minute or two
.venv/ready: EXTRA := dev
.venv/ready: SIZE := 2 to 6 GB on disk, by what comes with PyTorch; some minutes
.venv/demo .venv/docs .venv/fleet .venv/release .venv/ready: pyproject.toml constraints.txt | .venv/made
	@echo "installing failuretwin[$(EXTRA)] into .venv: $(SIZE)"
	$(BIN)/pip install --constraint constraints.txt --editable '.[$(EXTRA)]'
	touch $@

clean:
	rm -rf .venv build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis

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
