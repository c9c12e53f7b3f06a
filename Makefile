# Each target works alone on a machine with Python >= 3.11, make and git: it makes the environment it needs.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
STAMP = $(VENV)/.installed
DEMO_OUT ?= udccal-demo
ACCURACY_OUT ?= accuracy
ACCURACY_SEEDS ?= 8
EFFICIENCY_OUT ?= efficiency
PARETO_OUT ?= pareto
BUDGET_OUT ?= budget
LAMPS_OUT ?= lamps
DRIFT_OUT ?= drift
DRIFT_RIGS ?= 200
RIGS_OUT ?= drawn
RIGS ?= 12
LIVE_OUT ?= live.json
COVERAGE_OUT ?= coverage
OTHER_DAYS_OUT ?= other-days
GUIDED_OUT ?= guided
ROBUST_OUT ?= robust
NETWORK_MINUTES ?= 60
NETWORK ?=
ROBUST ?=
PEERS ?=
USB ?=

.PHONY: install demo test test-medium test-slow test-usb fuzz load lint types contracts check accuracy tables efficiency coverage extremes pareto full-size fewer device network budget lamps drift other-days guided rigs live robust peers growth docs clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c "import sys; sys.exit(None if sys.version_info >= (3, 11) else 'udccal needs Python 3.11 or newer: make PYTHON=python3.12')"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	touch $(STAMP)

demo: $(STAMP)
	$(BIN)/udccal demo --out $(DEMO_OUT)

test: $(STAMP)
	$(BIN)/python -m pytest -m "not slow and not medium" -n 2 --dist worksteal --durations=30

# Single fits and compilations of some seconds; continuous integration runs them too.
test-medium: $(STAMP)
	$(BIN)/python -m pytest -m "medium and not slow" -n 2 --dist worksteal --durations=30

test-slow: $(STAMP)
	$(BIN)/python -m pytest -m "slow or medium" -n 2 --dist worksteal --durations=30

# The USB3 Vision driver through libusb and a real kernel's USB: boots one in qemu, with a virtual camera plugged in.
# USB: arguments, such as --if-possible, which says so and goes on where qemu cannot be had.
test-usb: $(STAMP)
	$(BIN)/python -m tests.usb_stack $(USB)

# A hundred thousand broken inputs for every reader of bytes from outside.
fuzz: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[fuzz]"
	$(BIN)/python -m tests.fuzz.run --inputs 100000

# Ten thousand full-size frames through capture and averaging.
load: $(STAMP)
	$(BIN)/python -m tests.benchmarks.load --frames 10000

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy
	$(BIN)/mypy examples/*.py

contracts: $(STAMP)
	$(BIN)/lint-imports

check: lint types contracts test

# The table of docs/accuracy.md: two full-size rigs, and ACCURACY_SEEDS specimens of each reduced one. Goes on where it
# was stopped. Writes accuracy.json; non-zero exit where a number is missed.
accuracy: $(STAMP)
	$(BIN)/python -m tests.benchmarks.accuracy --out $(ACCURACY_OUT) --seeds $(ACCURACY_SEEDS)

# Every fit against its Cramér–Rao bound, and its error bars against the truth. Writes efficiency.json and the table of
# docs/numerics.md; non-zero exit where a figure is missed.
efficiency: $(STAMP)
	$(BIN)/python -m tests.benchmarks.efficiency.run --out $(EFFICIENCY_OUT)

# Stated error bars against the truth of rigs that no model describes. Writes the table of docs/numerics.md; non-zero exit
# where they hold too little.
coverage: $(STAMP)
	$(BIN)/python -m tests.benchmarks.coverage --out $(COVERAGE_OUT)

# Every fit at the ends of its range. Writes the table of docs/numerics.md; non-zero exit where one fails.
extremes: $(STAMP)
	$(BIN)/python -m tests.benchmarks.extremes.run

# Data sets drawn from wide families, at least 200 of each. Writes robust.json and the tables of docs/numerics.md;
# non-zero exit where one is wrong and nothing says so. ROBUST: arguments, such as --family noise or --again noise/137.
robust: $(STAMP)
	$(BIN)/python -m tests.benchmarks.robust.run --out $(ROBUST_OUT) $(ROBUST)

# udccal and its peers on the same works. Writes the table of docs/peers.md. PEERS: folder of works.py.
peers: $(STAMP)
	$(BIN)/python -m tests.benchmarks.peers.run $(if $(PEERS),--peers $(PEERS))

# Seconds and memory of every fit as its data double. Writes the table of docs/numerics.md.
growth: $(STAMP)
	$(BIN)/python -m tests.benchmarks.growth.run

# Simulated rigs, half of them changed, by `udccal check`. Writes a file per rig, which a second run goes on from, and the
# table of docs/drift.md.
drift: $(STAMP)
	$(BIN)/python -m tests.benchmarks.drift --rigs $(DRIFT_RIGS) --out $(DRIFT_OUT)

# The shipped profile against calibrations of its specimen on other days. Writes the tables of docs/diff.md,
# docs/validate.md and docs/check.md and the example of README.md; non-zero exit where a number misses its limit.
other-days: $(STAMP)
	$(BIN)/python -m tests.benchmarks.other_days --out $(OTHER_DAYS_OUT)

# Rigs captured by a hand that misses its aims, against exact captures, both fitted: one of full size and eight reduced
# ones. Goes on where it was stopped. Writes RIG.json and the tables of docs/cli.md; non-zero exit where a number misses
# its limit.
guided: $(STAMP)
	$(BIN)/python -m tests.benchmarks.guided --rig lg55-reduced --specimens 8 --out $(GUIDED_OUT)
	$(BIN)/python -m tests.benchmarks.guided --out $(GUIDED_OUT)

# Rigs of which every number, opening and noise is drawn, written by a program that is not udccal's. Goes on where it was
# stopped. Writes drawn.json and the table of docs/accuracy.md; non-zero exit where a profile is wrong and does not say so.
rigs: $(STAMP)
	$(BIN)/python -m tests.benchmarks.drawn_rigs --out $(RIGS_OUT) --rigs $(RIGS)

# Every tier of restoration on scenes of five kinds, and the planner. Writes pareto.json, pareto.csv, pareto.svg, a sheet
# of pictures per tier, and the tables of docs/restoration.md and README.md; non-zero exit where a number misses its
# limit. Nothing else should run meanwhile.
pareto: $(STAMP)
	$(BIN)/python -m tests.benchmarks.pareto --out $(PARETO_OUT)

# Time and memory of a full-size frame at each tier. Writes a table of docs/restoration.md; non-zero exit where a limit
# is missed. Nothing else should run meanwhile.
full-size: $(STAMP)
	$(BIN)/python -m tests.benchmarks.full_size

# What pictures lose by profiles of fewer captures: nine calibrations of the small rig.
fewer: $(STAMP)
	$(BIN)/python -m tests.benchmarks.pareto.calibrations

# The tiers that deblur on a GPU beside the CPU: time, and how far pictures differ. Writes the table of
# docs/restoration.md; where JAX finds no GPU it says so.
device: $(STAMP)
	$(BIN)/python -m tests.benchmarks.device

# Train the network of the tier accurate for NETWORK_MINUTES; writes its weights. NETWORK: arguments, such as --from.
network: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[train]"
	$(BIN)/python -m tests.benchmarks.network.train --minutes $(NETWORK_MINUTES) $(NETWORK)

# What each stage of restoration costs, with the truth in place of all others. Writes budget.json and the table of
# docs/restoration.md.
budget: $(STAMP)
	$(BIN)/python -m tests.benchmarks.budget --out $(BUDGET_OUT)

# Drawn frames with lamps beyond the range: what pictures gain where their halos are taken off. Writes lamps.json and
# the table of docs/restoration.md; non-zero exit where a limit is missed.
lamps: $(STAMP)
	$(BIN)/python -m tests.benchmarks.lamps --out $(LAMPS_OUT)

# Ten minutes of `udccal run` with the simulated camera at 30 Hz. Writes live.json; non-zero exit where frames dropped,
# latency or memory miss their limits. Nothing else should run meanwhile.
live: $(STAMP)
	$(BIN)/python -m tests.benchmarks.live --out $(LIVE_OUT)

# Puts the measured tables into docs/accuracy.md.
tables: $(STAMP)
	$(BIN)/python -m tests.benchmarks.readme_tables --accuracy $(ACCURACY_OUT)

# The documentation as a site of its own, in site/; non-zero exit where a link or a reference leads nowhere.
docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

clean:
	rm -rf $(VENV) $(DEMO_OUT) $(ACCURACY_OUT) $(EFFICIENCY_OUT) $(ROBUST_OUT) $(PARETO_OUT) $(BUDGET_OUT) $(LAMPS_OUT) $(OTHER_DAYS_OUT) $(GUIDED_OUT) $(RIGS_OUT) $(LIVE_OUT) site peers build dist *.egg-info
