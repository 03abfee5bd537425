# Every target sets up what it needs from a clean clone: git, make, a C compiler, cargo and
# Python >= 3.11 suffice, without root. Everything lands under the repository (.tools, .venv,
# target). The exception is CARGO_HOME, which stays the user's own, because it holds the
# configuration of their crate registry.

PYTHON ?= python3
# Of the extension, "release" or "quick"; that of the last build unless it is given.
PROFILE ?= $(or $(shell cat .tools/profile 2>/dev/null),release)
PINNED_UV := .tools/uv/bin/uv
# UV=/path/to/uv takes another than the pinned one.
UV ?= $(CURDIR)/$(PINNED_UV)
BIN := .venv/bin
ENVIRONMENT := .venv/.requirements
EXTENSION := python/haptether/_core.abi3.so

export UV
export UV_CACHE_DIR := $(CURDIR)/.tools/cache
export UV_PYTHON_DOWNLOADS := never
# The certificates of the machine, which pip and cargo go by as well.
export UV_SYSTEM_CERTS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export VIRTUAL_ENV := $(CURDIR)/.venv
export PYO3_PYTHON := $(CURDIR)/$(BIN)/python

CRATES := numeric safety netsim dynamixel master slave bridge python python/documented
RUST_SOURCES := Cargo.toml Cargo.lock $(wildcard $(CRATES:%=%/Cargo.toml)) \
    $(shell find $(CRATES:%=%/src) -type f) python/haptether/_core.pyi
SITE := out/site/html/index.html
SITE_SOURCES := $(wildcard *.md) $(shell find docs tools/docs -type f -not -name '*.pyc'; \
    find -L python/haptether -name '*.py' -o -name '*.pyi')
PYTHON_CODE := python/haptether \
    $(foreach folder,tests benches examples,$(if $(wildcard $(folder)/*.py),$(folder)))

# uv does not read pip's configuration: where that names a package index, uv is told of it.
USE_INDEX = index=$${UV_DEFAULT_INDEX:-$${PIP_INDEX_URL:-$$( \
    .tools/uv/bin/python -m pip config get global.index-url 2>/dev/null)}}; \
    if [ -n "$$index" ]; then export UV_DEFAULT_INDEX="$$index"; fi
COMPILE = "$(UV)" pip compile --quiet --universal --python-version 3.11 --generate-hashes \
    --no-emit-index-url --no-emit-find-links --custom-compile-command 'make lock' $(UPGRADE)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

.PHONY: help
help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## \(.*\)/make \1|\2/p' Makefile | \
	    while IFS='|' read -r target text; do printf '%-12s %s\n' "$$target" "$$text"; done

.PHONY: demo
demo: $(EXTENSION) ## run `haptether demo`
	@$(BIN)/haptether demo

NOT_THOROUGH = $() and not thorough
LIVE_AT_ONCE := 5
# `make test` judges the change and not the luck of a draw; `make thorough` draws new examples.
SAME_EXAMPLES = PROPTEST_RNG_SEED=1

# Tests of real time: options and markers of pytest. Each test that fails is retried once, by itself; out/retries.json
# lists the retries of both runs.
with_retries = $(BIN)/python -m tests.retry -m '$(2)' -- $(1)

.PHONY: test
test: $(EXTENSION) $(SITE) ## cargo test and pytest
	@rm -f out/retries.json
	$(SAME_EXAMPLES) cargo test --locked --workspace --profile quick --tests
	$(BIN)/python -m pytest --numprocesses 2 --dist worksteal -m 'not live and not alone$(NOT_THOROUGH)'
	$(call with_retries,--numprocesses $(LIVE_AT_ONCE) --dist worksteal,live and not alone$(NOT_THOROUGH))
	$(call with_retries,,alone$(NOT_THOROUGH))

.PHONY: thorough
thorough: NOT_THOROUGH :=
thorough: SAME_EXAMPLES :=
thorough: LIVE_AT_ONCE := 3
thorough: test ## `make test` with all cases of what it samples, in about half an hour

.PHONY: quick
quick: $(EXTENSION) ## after a change of Python, in about a minute: ruff, mypy, the quick tests
	$(BIN)/ruff check --quiet .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy $(PYTHON_CODE)
	$(BIN)/python -m pytest --quiet --exitfirst --numprocesses 2 -m 'not live and not alone and not slow'

.PHONY: lint
lint: $(EXTENSION) ## formatting, clippy, ruff, sentences, mypy, the extension's stub, the licences
	cargo fmt --all --check
	cargo clippy --locked --workspace --profile quick --all-targets -- -D warnings
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python tools/words.py
	$(BIN)/mypy $(PYTHON_CODE)
	$(BIN)/python -m mypy.stubtest haptether._core
	$(BIN)/python -m pytest --quiet tests/packaging/test_licences.py

.PHONY: bench
bench: PROFILE := release
bench: $(EXTENSION) .venv/.bench ## run benches/*.py, one after the other
	@status=0; for bench in $(wildcard benches/[!_]*.py); do \
	    echo "== $$bench"; $(BIN)/python "$$bench" || status=1; \
	done; exit $$status

# What it finds new lands in out/fuzz, what makes a target fail in fuzz/artifacts. No sanitizer: they need a nightly
# compiler, and the code under test is safe Rust. FUZZ_SECONDS is for each target.
FUZZ_SECONDS ?= 60
FUZZ_TARGETS := $(notdir $(basename $(wildcard fuzz/fuzz_targets/*.rs)))
CARGO_FUZZ := .tools/cargo-fuzz/bin/cargo-fuzz

.PHONY: fuzz
fuzz: $(EXTENSION) $(CARGO_FUZZ) ## fuzz every target for FUZZ_SECONDS (60) each
	$(CARGO_FUZZ) fuzz build --sanitizer none
	@for target in $(FUZZ_TARGETS); do \
	    echo "== $$target"; mkdir -p out/fuzz/$$target; \
	    $(CARGO_FUZZ) fuzz run --sanitizer none $$target out/fuzz/$$target fuzz/corpus/$$target -- \
	        -max_total_time=$(FUZZ_SECONDS) -rss_limit_mb=1024 -timeout=10 -print_final_stats=1 || exit 1; \
	done
	HAPTETHER_HYPOTHESIS_PROFILE=slow $(BIN)/python -m pytest --timeout 0 tests/scene/test_corpus.py

$(CARGO_FUZZ):
	@echo "installing cargo-fuzz into .tools"
	@cargo install --quiet --locked --root .tools/cargo-fuzz --version 0.13.2 cargo-fuzz

SOAK_SECONDS ?= 600

.PHONY: soak
soak: $(EXTENSION) ## master, network and slave for SOAK_SECONDS (600): memory must stay flat
	@$(BIN)/python -m tests.soak --seconds $(SOAK_SECONDS) --json out/soak.json

.PHONY: faults
faults: $(EXTENSION) ## every fault, what is expected, what was seen (about 25 minutes)
	@$(BIN)/python -m tests.faults --json out/faults.json

# After the environment, which is made anew without it when its requirements change.
.venv/.bench: tools/bench.txt $(ENVIRONMENT)
	@echo "installing tools/bench.txt into .venv"
	@$(USE_INDEX); "$(UV)" pip install --quiet --require-hashes --requirement tools/bench.txt
	@touch $@

.PHONY: docs
docs: $(SITE) ## build the documents and the Python API as a site, out/site/html/index.html

$(SITE): $(EXTENSION) .venv/.docs $(SITE_SOURCES)
	$(BIN)/python tools/docs/build.py

.venv/.docs: tools/docs.txt $(ENVIRONMENT)
	@echo "installing tools/docs.txt into .venv"
	@$(USE_INDEX); "$(UV)" pip install --quiet --require-hashes --requirement tools/docs.txt
	@touch $@

.PHONY: setup
setup: $(EXTENSION) ## only make the environment in .venv and build the extension

.PHONY: wheel
wheel: $(ENVIRONMENT) ## build a wheel for Python 3.11 and newer, and the source distribution, into dist
	$(BIN)/maturin build --release --locked --out dist
	$(BIN)/maturin sdist --out dist

.PHONY: lock
lock: $(PINNED_UV) ## renew tools/*.txt (UPGRADE=--upgrade takes the newest versions)
	@$(USE_INDEX); set -x; \
	    $(COMPILE) --extra all --group dev --output-file tools/requirements.txt pyproject.toml
	@$(USE_INDEX); set -x; \
	    $(COMPILE) --group bench --constraint tools/requirements.txt --output-file tools/bench.txt
	@$(USE_INDEX); set -x; \
	    $(COMPILE) --group docs --constraint tools/requirements.txt --output-file tools/docs.txt
	@$(USE_INDEX); set -x; $(COMPILE) --output-file tools/uv.txt tools/uv.in
	@$(BIN)/python tools/sbom.py >python/haptether.cdx.json

.PHONY: images
images: $(EXTENSION) ## make the pictures of docs/images anew, where Chromium and EGL are (some minutes)
	@$(BIN)/python -m tests.images

.PHONY: clean
clean: ## remove all that these targets made
	rm -rf .tools .venv target fuzz/target fuzz/artifacts out dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
	rm -f $(EXTENSION)
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Asked at every run; written, and so everything below it rebuilt, only when the answer is new.
.tools/interpreter: FORCE
	@mkdir -p .tools
	@tools/prerequisites '$(PYTHON)' > $@.new
	@if cmp -s $@.new $@; then rm $@.new; else mv $@.new $@; fi

.tools/profile: FORCE
	@mkdir -p .tools
	@echo $(PROFILE) > $@.new
	@if cmp -s $@.new $@; then rm $@.new; else mv $@.new $@; fi

.PHONY: FORCE
FORCE:

$(PINNED_UV): tools/uv.txt .tools/interpreter
	@echo "installing uv into .tools"
	@rm -rf .tools/uv
	@'$(PYTHON)' -m venv --clear .tools/uv
	@.tools/uv/bin/python -m pip install --quiet --require-hashes --requirement tools/uv.txt
	@touch $@

$(ENVIRONMENT): tools/requirements.txt .tools/interpreter $(if $(findstring .tools/,$(UV)),$(PINNED_UV))
	@echo "installing tools/requirements.txt into .venv"
	@"$(UV)" venv --quiet --clear --python "$$(sed 's/ [^ ]*$$//' .tools/interpreter)" .venv
	@$(USE_INDEX); "$(UV)" pip install --quiet --require-hashes --requirement tools/requirements.txt
	@touch $@

# Offline, so that a dependency that the lock lacks is noticed and not fetched past it.
$(EXTENSION): $(ENVIRONMENT) pyproject.toml $(RUST_SOURCES) .tools/profile
	@echo "building the extension, profile $(PROFILE)"
	@PATH="$$(dirname "$(UV)"):$$PATH" UV_OFFLINE=1 $(BIN)/maturin develop --profile $(PROFILE) --locked --uv
	@touch $@
