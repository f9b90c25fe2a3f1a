# One virtual environment, made once and again only when the dependencies change.
#
#   make train ARGS="num_envs=256 max_iterations=100"    make demo    make test    make lint    make bench

PYTHON ?= python3
IS_RECENT := import sys; sys.exit(sys.version_info < (3, 11))
VENV ?= .venv
BIN := $(VENV)/bin
ARGS ?=
# Python compiles a module at its first import; to compile all 17,000 of them takes over a minute.
INSTALL := $(BIN)/python -m pip install -q --no-compile -c constraints.txt

# .venv of an older Python is made anew; an environment that VENV names is left alone.
ifneq ($(filter install install-dev train demo test test-slow lint ruff format docs bench wheel,$(MAKECMDGOALS)),)
ifeq ($(VENV),.venv)
REMOVED := $(shell if [ -x .venv/bin/python ] && ! .venv/bin/python -c '$(IS_RECENT)' 2>/dev/null; then rm -rf .venv; fi)
endif
endif

.DEFAULT_GOAL := help
.PHONY: help install install-dev train demo test test-slow lint ruff format docs bench wheel clean

help:
	@echo "make install      virtual environment with the tested set of packages; then: . $(BIN)/activate"
	@echo "make train        install, then train HumanoidAMP; ARGS=\"key=value ...\" adds settings"
	@echo "make demo         install, then ask which of the trained policies to film: demo/*.mp4"
	@echo "make test         install-dev, lint, and the fast tests"
	@echo "make test-slow    the slow tests"
	@echo "make lint         ruff and pyright;   make format   lets ruff rewrite the files"
	@echo "make docs         the documentation as a site: docs/_build/html/index.html"
	@echo "make bench        speed and memory"
	@echo "make wheel        build the wheel into dist/"
	@echo "make clean        remove the virtual environment, builds and caches (not runs/)"

install: $(VENV)/.installed
install-dev: $(VENV)/.installed-dev

$(BIN)/python:
	@$(PYTHON) -c '$(IS_RECENT)' 2>/dev/null || { \
	  echo "$(PYTHON) is $$($(PYTHON) --version 2>&1), but Python 3.11 to 3.13 is needed: make PYTHON=python3.12 ..."; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { \
	  rm -rf $(VENV); echo "$(PYTHON) lacks venv: install python3-venv (Debian, Ubuntu), then again"; exit 1; }

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing into $(VENV): about 2 minutes, 1.3 GB"
	$(INSTALL) -e .
	touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing into $(VENV): about 3 minutes, 2 GB"
	$(INSTALL) -e ".[dev]"
	touch $@ $(VENV)/.installed

# DeepMimic's clips, which some policies imitate, are in a package of 100 MB; no wheel fits every Python.
$(VENV)/.installed-video: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing into $(VENV): about 2 minutes, 1.6 GB"
	$(INSTALL) --only-binary pybullet -e ".[video,motions]" || $(INSTALL) -e ".[video]"
	touch $@ $(VENV)/.installed

train: install
	$(BIN)/python train.py task=HumanoidAMP $(ARGS)

demo: $(VENV)/.installed-video
	$(BIN)/python -m isaacgymenvs_lite demo $(ARGS)

# pyright needs one CPU for half a minute: it runs beside the tests, and its lines come after theirs.
test: ruff
	@types=$$(mktemp); $(BIN)/pyright --pythonpath $(BIN)/python >$$types 2>&1 & pyright=$$!; \
	$(BIN)/python -m pytest -n logical --dist loadfile $(ARGS); tests=$$?; \
	wait $$pyright; code=$$?; cat $$types; rm $$types; \
	exit $$((tests ? tests : code))

test-slow: install-dev
	$(BIN)/python -m pytest -m slow -n logical --timeout 1800 $(ARGS)

lint: ruff
	$(BIN)/pyright --pythonpath $(BIN)/python

ruff: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: install-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# A warning is an error: a broken link, a docstring that does not render.
docs: install-dev
	$(BIN)/python -m sphinx -q -W --keep-going -b html docs docs/_build/html

bench: install
	$(BIN)/python benchmarks/run.py $(ARGS)

wheel: install-dev
	$(BIN)/python -m hatchling build -t wheel

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
