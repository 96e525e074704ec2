# The book and its library. Needs Python 3.11 or newer, pip and make.
#   make book      the environment, the library and the HTML, warnings as errors
#   make test      the book, then every check; `make help` lists the rest

ifndef PYTHON
PYTHON := $(shell for p in python3.11 python3 python; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& { command -v "$$p"; break; }; done)
endif
VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip install --quiet --disable-pip-version-check
STAMP := $(VENV)/stamp
HTML := _build/html

# One thread in each BLAS, so that two runs give the same digits; book/tools pins the same for kernels.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export PYTHONHASHSEED := 0
export MPLCONFIGDIR := $(CURDIR)/$(VENV)/matplotlib

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help environment book test unit types style pairs regress slow outputs identical studies bench portable lab lock clean

help:
	@echo "make book       environment, library and HTML (warnings are errors); prints the page's path"
	@echo "make test       the book, then unit, property and doc tests, types, style, pairs, stored outputs, browser"
	@echo "make slow       the tests that take minutes"
	@echo "make outputs    execute every chapter, store its outputs, write the ledger of reproductions"
	@echo "make identical  execute every chapter again and compare byte for byte with what is stored"
	@echo "make studies    run the studies that take too long for a chapter, store them in data/studies"
	@echo "make portable   stored outputs on another BLAS kernel and without numpy's newer SIMD"
	@echo "make bench      side-by-side measurements, written to data/bench"
	@echo "make lab        JupyterLab on the chapters"
	@echo "make lock       resolve requirements.txt again"
	@echo "make clean      remove what was built (the environment stays)"

environment: $(STAMP)

$(STAMP): requirements.txt pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer was not found: make PYTHON=/path/to/python"; exit 1; }
	test -x $(PY) || "$(PYTHON)" -m venv $(VENV)
	$(PIP) -r requirements.txt
	$(PIP) --no-deps --no-build-isolation --editable .
	@$(PY) -W ignore -c "import matplotlib.font_manager"
	@touch $@

# Built afresh each time: a page that is not read again would not repeat its warnings.
book: $(STAMP)
	rm -rf $(HTML)
	$(PY) -m sphinx -b html -W --keep-going -q -E -d _build/doctrees -c book . $(HTML)
	@echo "The book: $(CURDIR)/$(HTML)/book/index.html"

test: book unit types style pairs regress

unit: $(STAMP)
	$(PY) -m pytest -q

types: $(STAMP)
	$(PY) -m mypy

style: $(STAMP)
	$(PY) -m ruff check distfilt tests book conftest.py

pairs: $(STAMP)
	$(PY) book/tools/pairs.py
	$(PY) book/tools/ledger.py --check

regress: $(STAMP)
	$(PY) book/tools/regress.py

slow: $(STAMP)
	$(PY) -m pytest -q -m slow

outputs: $(STAMP)
	$(PY) book/tools/execute.py
	$(PY) book/tools/ledger.py

identical: $(STAMP)
	$(PY) book/tools/execute.py --check

portable: $(STAMP)
	$(PY) book/tools/regress.py --portable

studies: $(STAMP)
	$(PY) book/tools/studies.py

bench: $(STAMP)
	mkdir -p data/bench
	set -e; for script in tests/bench/bench_*.py; do echo "$$script"; $(PY) "$$script"; done

lab: $(STAMP)
	$(PY) -m jupyterlab --notebook-dir=book

lock: $(STAMP)
	$(PY) -m uv pip compile --quiet --universal --python-version 3.11 --no-emit-index-url \
		--no-emit-find-links --no-header --no-annotate --extra book --extra test \
		pyproject.toml requirements.in --output-file requirements.txt

clean:
	rm -rf _build dist book/_generated .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path "./$(VENV)/*" -prune -exec rm -rf {} +
