# `make train` and `make test` do all the set-up. PYTHON names the interpreter that the environment is made from.
PYTHON ?= python3
SEEDS ?= 5
# Two processes, each file in one of them: most of the time goes into compiling, which uses one core.
PARALLEL := --numprocesses 2 --dist loadfile --durations 20
ENVIRONMENT := .venv
READY := $(ENVIRONMENT)/.ready

.PHONY: train test test-long lint clean

train: $(READY)
	$(ENVIRONMENT)/bin/infogoal train object_search --seeds $(SEEDS)

test: $(READY) lint
	$(ENVIRONMENT)/bin/python -m pytest -q $(PARALLEL)

test-long: $(READY)
	$(ENVIRONMENT)/bin/python -m pytest -q $(PARALLEL) -m "long or not long"

lint: $(READY)
	$(ENVIRONMENT)/bin/ruff check .

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(ENVIRONMENT)
	$(ENVIRONMENT)/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[test]'
	touch $@

clean:
	rm -rf $(ENVIRONMENT) build *.egg-info
