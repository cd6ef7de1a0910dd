# nnss: everything runs in .venv, made here from constraints.txt.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
# Where the CPU build of torch comes from when the package index has none.
# For CUDA: make install TORCH_INDEX=https://download.pytorch.org/whl/cu130
TORCH := 2.13.0
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

SEEDS ?= 10
OUT ?= results
ARGS ?=
MUTANTS ?= 200
PAGE ?=
NNSS := $(BIN)/nnss

.DEFAULT_GOAL := help
.PHONY: help install demo testdata test test-system test-slow test-page soak mutants lint format docs reproduce studies benchmarks bench clean

help: ## Show this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14
	@echo "Variables: SEEDS=$(SEEDS) OUT=$(OUT) MUTANTS=$(MUTANTS) ARGS='--jobs 1' PYTHON=$(PYTHON)"

install: $(VENV)/.installed ## Make .venv with nnss and its tools (CPU build of torch)

# A CPU build from the index at hand, else from PyTorch's own index: PyPI's Linux wheel brings several GB of CUDA.
$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; v >= (3, 11) or sys.exit(f"nnss needs Python 3.11 or newer, found {v[0]}.{v[1]}: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	@echo "installing torch $(TORCH)"
	@$(PIP) torch==$(TORCH)+cpu 2>/dev/null || $(PIP) --index-url $(TORCH_INDEX) torch==$(TORCH) || $(PIP) torch==$(TORCH)
	@echo "installing nnss"
	@$(PIP) --editable '.[tune,certify,test,lint]'
	@touch $@

demo: install ## A small comparison on the embedded plant: no download, a few minutes
	$(NNSS) compare twotank-sim --orders 2 3 --seeds 5 --epochs 150 --out $(OUT)/demo $(ARGS)
	@echo "box plot: $(OUT)/demo/twotank-sim/paper/boxplot.png"

# Where no folder with the real records is named or near, they are fetched; without network their tests are skipped.
testdata: install
	@$(BIN)/python tests/real_files.py .testdata

test: install testdata ## Run the quick tests
	$(BIN)/python -m pytest -q -n 2 $(ARGS)

test-system: install testdata ## Run whole commands, trainings, proofs and sweeps, as CI does
	$(BIN)/python -m pytest -q -n 2 -m "system and not slow" $(ARGS)

test-slow: install testdata ## Run all tests, the slow ones too
	$(BIN)/python -m pytest -q -n 2 -m "slow or not slow" $(ARGS)

# Its browser comes from the npm registry, or is the one that NNSS_BROWSER names. PAGE=results/report.html: that page.
test-page: install ## The tests of the HTML report in a headless browser: PAGE=FILE for a page of one's own
	@$(PIP) --editable '.[tune,certify,test,lint,browser]'
	@$(BIN)/python tests/browser/fetch.py .browser
	NNSS_BROWSER_REQUIRED=1 NNSS_PAGE=$(abspath $(PAGE)) $(BIN)/python -m pytest -q tests/browser tests/report/test_html_numbers.py

# Not part of the tests: an hour or two.
soak: install ## Kill and interrupt sweeps at random and in each phase; figures in docs/reliability.md: ARGS='--times 5'
	$(BIN)/python tests/soak.py $(ARGS)

# Not part of the tests: an hour or so. .mutants/survivors.diff tells what no test noticed; docs/testing.md.
mutants: install testdata ## How many small faults in the code the tests notice, on a sample: MUTANTS=200 ARGS='--seed 0'
	@$(PIP) --editable '.[tune,certify,test,mutants]'
	$(BIN)/python tests/mutants.py --sample $(MUTANTS) $(ARGS)

# mypy does not follow the mapping of datasets/ and baselines/ into the package in an editable
# install, so it reads an installed copy.
lint: install ## ruff and mypy
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	@rm -rf build
	@$(PIP) --no-deps --no-build-isolation --target build/lint .
	cd build/lint && ../../$(BIN)/mypy --config-file ../../pyproject.toml -p nnss_cli

format: install ## Let ruff mend what it can
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

METHODS := nnss nnss-ensemble nnss-paper simba n4sid ssest ssregest

# Exit code 1: some runs have no result, which the tables count.
reproduce: install ## The paper's study and ours, ending in results/report.md and report.html: SEEDS=10, or small with SEEDS=1 ARGS='--epochs 5'
	$(NNSS) compare twotank --orders 2 3 4 --seeds $(SEEDS) --methods $(METHODS) --out $(OUT) $(ARGS) || [ $$? = 1 ]
	$(NNSS) compare daisy-powerplant --orders 3 4 5 --seeds $(SEEDS) --methods $(METHODS) --out $(OUT) $(ARGS) || [ $$? = 1 ]
	$(NNSS) compare robotarm --orders 4 5 6 --seeds $(SEEDS) --methods $(METHODS) --out $(OUT) $(ARGS) || [ $$? = 1 ]
	for dataset in twotank daisy-powerplant robotarm; do \
	  $(NNSS) compare $$dataset --protocol strict --seeds $(SEEDS) --out $(OUT) $(ARGS) || [ $$? = 1 ] || exit; \
	done
	$(NNSS) report --no-times --html --out $(OUT)

studies: install ## Ablations and the price of stability, to be followed by `make reproduce` for the report
	for dataset in twotank daisy-powerplant robotarm; do for study in recipe class stability; do \
	  $(NNSS) ablate $$dataset --study $$study --seeds $(SEEDS) --out $(OUT) $(ARGS) || exit; \
	done; done

# Record and order; a run of the longest takes some ten minutes.
OFFICIAL := cascaded-tanks:2 ced:3 silverbox:3 emps:3 wiener-hammerstein:6

benchmarks: install ## The official records beside their published errors, five seeds: SEEDS=5
	for pair in $(OFFICIAL); do \
	  $(NNSS) compare $${pair%:*} --orders $${pair#*:} --seeds $(if $(filter file,$(origin SEEDS)),5,$(SEEDS)) \
	    --methods nnss nnss-ensemble ssest --out $(OUT)/official $(ARGS) || [ $$? = 1 ] || exit; \
	done
	$(NNSS) report --out $(OUT)/official

docs: install ## The docs folder as a site, strictly, in build/site; the tutorial is run
	@$(PIP) --editable '.[tune,certify,test,lint,docs]'
	$(BIN)/mkdocs build --strict
	$(BIN)/python -m pytest -q tests/test_site.py -m "slow or not slow"

bench: install ## Engines and N4SID against other ways to do it, as ratios in one run; ARGS='--jax --torch-compile'
	$(BIN)/python benchmarks/training.py $(ARGS)
	$(BIN)/python benchmarks/subspace.py

clean: ## Remove .venv and build products; results/ stays
	rm -rf $(VENV) build dist *.egg-info .mutants .pytest_cache .mypy_cache .ruff_cache .hypothesis
