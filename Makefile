# SPDX-License-Identifier: Apache-2.0
# One word each.  On a fresh machine: make install, make demo.

PYTHON ?= $(firstword $(foreach name,python3.11 python3.12 python3.13 python3.14 python3,$(shell command -v $(name))))
BIN := .venv/bin
DIVE ?= voyage_2
# Processes that the tests share.
TESTERS ?= 2
INSTALLED := .venv/.installed
DEVELOPED := .venv/.developed
PEERED := .venv/.peered
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check
COMPILE := uv pip compile pyproject.toml --universal --python-version 3.11 --generate-hashes \
	--no-emit-index-url --custom-compile-command "make pins"

.PHONY: help install develop demo test docs package coverage fuzz lint types check sample schemas bench accuracy verdicts peers compare-peers compare-readers pictures pythons real-logs audit pins clean

help:  ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1	/p' Makefile

install: $(INSTALLED)  ## a virtual environment in .venv with the pinned packages and the command abyssnav

$(INSTALLED): .ci/requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "needs Python 3.11 or later; found: $(PYTHON).  make install PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv .venv
	$(PIP) --require-hashes -r .ci/requirements.txt
	$(PIP) --no-deps --no-build-isolation --editable .
	@touch $@

# What only tests and linters need, on top.
$(DEVELOPED): $(INSTALLED) .ci/requirements-dev.txt
	$(PIP) --require-hashes -r .ci/requirements-dev.txt
	@touch $@

develop: $(DEVELOPED)  ## what tests, linters and pages need, on top of that

demo: install  ## one sample dive, end to end
	$(BIN)/abyssnav run sample_logs/$(DIVE).mcap --output out
	@echo "Look at it:  $(BIN)/abyssnav view out/$(DIVE)"

test: $(DEVELOPED)  ## the tests that need neither network nor minutes
	$(BIN)/python -m pytest -q -n $(TESTERS) --dist worksteal -m "not network and not slow and not pages"

fuzz: $(DEVELOPED)  ## every parser of foreign bytes, and whole runs, under some thousand random inputs, some minutes
	ABYSSNAV_FUZZ=2000 $(BIN)/python -m pytest -q tests/test_fuzz_formats.py tests/test_metamorphic.py

lint: $(DEVELOPED)  ## style and formatting
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(DEVELOPED)  ## strict type check of the package; calls, names and attributes of the tests
	$(BIN)/mypy
	$(BIN)/mypy --config-file tests/mypy.ini tests

check: lint types  ## lint, types and every test, the slow and the real logs included
	$(BIN)/python -m pytest -q

sample: $(DEVELOPED)  ## sample_logs/ made anew from the shipped scenarios
	for scenario in clean voyage_1 voyage_2; do \
		$(BIN)/abyssnav simulate $$scenario --output sample_logs/$$scenario.mcap || exit 1; done
	head -c 1200000 sample_logs/voyage_1.mcap > sample_logs/cut_short.mcap
	$(BIN)/python tests/vehicles.py

schemas: $(DEVELOPED)  ## schemas/*.schema.json and the pages of docs/reference, from the code
	$(BIN)/python tests/json_schemas.py
	$(BIN)/python tests/reference_pages.py

docs: $(DEVELOPED)  ## the site into site/, without a warning; what its pages say is typed in; the notebook
	$(BIN)/python -P -m sphinx -W --keep-going -q docs site
	$(BIN)/python -m pytest -q -m pages
	$(BIN)/python tests/notebooks.py

package: $(DEVELOPED)  ## wheel and sdist, checked, installed into empty environments and run there
	.ci/package $(BIN)/python

coverage: $(DEVELOPED)  ## the tests with the share of the lines that they run, and which they do not
	$(BIN)/python -m pytest -q -n $(TESTERS) -m "not network and not slow and not pages" --cov --cov-report=term-missing:skip-covered

bench: $(DEVELOPED)  ## speed and memory, measured on this machine
	$(BIN)/python tests/bench.py

accuracy: $(DEVELOPED)  ## Monte Carlo of the navigator: errors over the Cramér-Rao bound, consistency, radius, causes
	OMP_NUM_THREADS=1 $(BIN)/python tests/accuracy.py

verdicts: $(DEVELOPED)  ## faults planted alone in simulated dives: how often each is named, and no lie
	OMP_NUM_THREADS=1 $(BIN)/python tests/verdicts.py

peers: $(PEERED)  ## what others have made, to be run beside ours

$(PEERED): $(DEVELOPED) pyproject.toml
	$(PIP) --upgrade 'pip>=25.1'
	$(PIP) --group peers
	@touch $@

compare-peers: $(PEERED)  ## beside GTSAM, navlie, FilterPy and a SciPy script, on the benchmark and a real survey
	$(BIN)/python tests/peers/compare_peers.py --out out/peers
	-$(BIN)/python tests/peers/compare_peers.py --out out/peers --real
	OMP_NUM_THREADS=1 $(BIN)/python tests/peers/gtsam_same_states.py

compare-readers: $(PEERED)  ## beside every other reader of MCAP in Python
	$(BIN)/python tests/peers/readers.py

pictures: demo $(DEVELOPED)  ## docs/ made anew: recording, map, report, print, phone, messages (needs Chromium, poppler and a Vulkan driver)
	$(BIN)/python tests/pictures.py out/$(DIVE) docs

pythons: $(DEVELOPED)  ## sample dives under every Python of this machine: the same bytes? (asks a registry)
	$(BIN)/python tests/pythons.py

real-logs: $(DEVELOPED)  ## a published survey fetched, turned into a log and run
	$(BIN)/python tests/real_logs.py
	$(BIN)/python tests/real_logs.py --noisier

audit: $(DEVELOPED)  ## known vulnerabilities of the pinned packages; fails where it cannot be asked of any (asks a registry)
	$(PIP) pip-audit
	$(BIN)/python -m pip_audit --strict --require-hashes -r .ci/requirements.txt

pins:  ## .ci/requirements*.txt made anew (needs uv)
	$(COMPILE) --extra build --group dev --output-file .ci/requirements-dev.txt
	$(COMPILE) --extra build --constraint .ci/requirements-dev.txt --output-file .ci/requirements.txt

clean:  ## everything that was made here, the virtual environment included
	rm -rf .venv out dist build site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
