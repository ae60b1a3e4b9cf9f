# `make train` and `make test` do all the set-up. PYTHON names the interpreter that the environment is made from.
PYTHON ?= python3
SEEDS ?= 2
# Two processes, each file in one of them, the longest files first (tests/conftest.py): most of the time goes into
# compiling, which uses one core.
PARALLEL := --numprocesses 2 --dist loadfile --no-loadscope-reorder --durations 20
# Most programs of `make test` run for less than a second: they are compiled without optimising, by options that the
# installed jax has. The long tests, which `make test-long` runs after it, train for minutes: their programs are compiled
# as the command line does it (infogoal_jax/runner/compilation.py).
COMPILE_QUICKLY = $$(cat $(ENVIRONMENT)/.quickly)
COMPILE_AS_USED := --xla_backend_optimization_level=1
TESTS ?= tests
ENVIRONMENT := .venv
# Compiled programs outlive a session: the next one compiles what has changed (tests/conftest.py).
KEPT := INFOGOAL_TEST_PROGRAMS=$(ENVIRONMENT)/programs
READY := $(ENVIRONMENT)/.ready
READY_FOR_ALL := $(ENVIRONMENT)/.ready-for-all

.PHONY: train test test-long lint docs wheel clean

train: $(READY)
	$(ENVIRONMENT)/bin/infogoal train object_search --small --seeds $(SEEDS)

# Bytecode is kept as well, where the shell says not to: each worker would read every module and rewrite every assertion.
test test-long: export PYTHONDONTWRITEBYTECODE =

test: $(READY) lint
	$(KEPT) XLA_FLAGS="$(XLA_FLAGS) $(COMPILE_QUICKLY)" $(ENVIRONMENT)/bin/python -m pytest -q $(PARALLEL) $(TESTS)

test-long: test $(READY_FOR_ALL)
	$(KEPT) XLA_FLAGS="$(XLA_FLAGS) $(COMPILE_AS_USED)" $(ENVIRONMENT)/bin/python -m pytest -q $(PARALLEL) -m long $(TESTS)

lint: $(READY)
	$(ENVIRONMENT)/bin/ruff check . && $(ENVIRONMENT)/bin/ruff format --check .

# The documentation site, in site/: it opens without a server. A warning or a broken link is an error.
docs: $(READY_FOR_ALL)
	NO_MKDOCS_2_WARNING=1 $(ENVIRONMENT)/bin/mkdocs build --quiet

# A wheel and a source distribution, in dist/, ready for an index.
wheel: $(READY)
	rm -rf build dist
	$(ENVIRONMENT)/bin/python -m pip install --quiet build
	$(ENVIRONMENT)/bin/python -m build --outdir dist

# What the site and the long tests need besides.
$(READY_FOR_ALL): $(READY)
	$(ENVIRONMENT)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[docs,ray,wandb]'
	touch $@

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(ENVIRONMENT)
	$(ENVIRONMENT)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[test]'
	$(ENVIRONMENT)/bin/python -m pip install --quiet --constraint constraints.txt --no-deps djitellopy
	JAX_PLATFORMS=cpu $(ENVIRONMENT)/bin/python -c "from infogoal_jax.runner.compilation import *; print(flags(QUICKEST))" \
		> $(ENVIRONMENT)/.quickly
	touch $@

clean:
	rm -rf $(ENVIRONMENT) build site *.egg-info
