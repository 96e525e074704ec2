# The book and its library. Needs Python 3.11 or newer, pip and make.
#   make book      the environment, the library and the HTML, warnings as errors
#   make test      the book, then every check
# `make help` lists the other targets.

ifndef PYTHON
PYTHON := $(shell for p in python3.11 python3 python; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& { command -v "$$p"; break; }; done)
endif
VENV := .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/stamp
HTML := _build/html
BUILT := _build/book.stamp
LAB := _build/lab
JOBS := 2
# The largest pages first, so that no core idles at the end.
PAGES := $(shell ls -S $$(sed -n 's|.* \(book/[0-9].*\)|\1.ipynb|p' _toc.yml) book/index.ipynb \
	| sed 's|book/\([0-9a-z]*\).*|regress-\1|')
SOURCES := distfilt tests book conftest.py
SAMPLE := 300
VERSIONS := lowest-direct highest

# One thread in each BLAS, so that two runs give the same digits; book/tools pins the same for kernels.
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export PYTHONHASHSEED := 0
# Some fifty processes of the tests import the library; without bytecode each would compile it.
unexport PYTHONDONTWRITEBYTECODE
export MPLCONFIGDIR := $(CURDIR)/$(VENV)/matplotlib

.DEFAULT_GOAL := help
# Targets run one after the other; only the checks of `make test` share the cores.
ifndef CHECKING
.NOTPARALLEL:
endif
.PHONY: help environment remake book test unit types style check-notebooks regress slow outputs \
	check-determinism update-scenarios studies check-studies bench mutants check-portability \
	test-versions lab lock dist pdf epub slides clean $(PAGES)

help:
	@echo "make environment        the packages and the library, in .venv"
	@echo "make book               environment and HTML (warnings are errors); prints the page's path"
	@echo "make pdf, make epub     the whole book in one file (needs Chromium and its driver)"
	@echo "make slides             the pictures for a lecture, in _build/slides"
	@echo "make test               the book, then every check: the next five, and the browser"
	@echo "  make unit             unit, property and doc tests"
	@echo "  make types            mypy in strict mode"
	@echo "  make style            ruff: rules and format; warns of public names that the book never uses"
	@echo "  make check-notebooks  each chapter's text against its notebook, numbers in prose, the ledger"
	@echo "  make regress          every chapter executed again and compared with its stored outputs"
	@echo "make slow               the tests that take minutes, and new examples for the property tests"
	@echo "make outputs            execute every chapter, store its outputs, write the ledger of reproductions"
	@echo "make check-determinism  execute chapters again (all, or CHAPTERS=...): texts byte for byte, pictures by pixels"
	@echo "make update-scenarios   accept the scenarios as they are now"
	@echo "make studies            run the studies that take too long for a chapter, store them in data/studies"
	@echo "make check-studies      run every stored study again and compare"
	@echo "make check-portability  stored outputs and the library's tests on another BLAS kernel and without newer SIMD"
	@echo "make test-versions      the library's tests with the oldest and the newest packages that it supports"
	@echo "make bench              side-by-side measurements, written to data/bench if the machine is idle"
	@echo "make mutants            how many of SAMPLE=300 random mutations the tests detect, written to data/bench"
	@echo "make lab                JupyterLab on a working copy of the chapters (LAB=folder for another one)"
	@echo "make lock               resolve requirements.txt again"
	@echo "make dist               wheel and source archive in dist; README's code runs with each, alone"
	@echo "make clean              remove what was built (the environment and the working copy stay)"

environment: $(STAMP)

# The stamp is written last and holds this folder's path. If it is missing or names another
# folder, the environment is made again.
ifneq ($(shell $(PY) -c "" 2>/dev/null && cat $(STAMP) 2>/dev/null),$(CURDIR))
$(STAMP): remake
endif
$(STAMP): requirements.txt pyproject.toml book/kit/pyproject.toml
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer was not found: make PYTHON=/path/to/python"; exit 1; }
	@"$(PYTHON)" -B book/tools/environment.py $(VENV)

remake:

# Always built from scratch: a page taken from the cache would not repeat its warnings.
$(BUILT): $(STAMP) _toc.yml CITATION.cff \
		$(shell find book distfilt data -type f ! -path "*/__pycache__/*" ! -path "*/_generated/*" ! -path "*/.*")
	rm -rf $(HTML) $@
	$(PY) -m sphinx -b html -j auto -W --keep-going -q -E -d _build/doctrees -c book . $(HTML)
	@touch $@

book: $(BUILT)
	@echo "The book: $(CURDIR)/$(HTML)/book/index.html"

slides: $(STAMP)
	$(PY) book/tools/slides.py

pdf epub: book
	$(PY) book/tools/volume.py $@

# Each page of the book is a check of its own; JOBS checks run at a time.
test: book
	@$(MAKE) --no-print-directory -k -j$(JOBS) CHECKING=1 JOBS=1 unit types style check-notebooks $(PAGES)

# Without reordering, the files with few but long tests come first.
unit: $(STAMP)
	HYPOTHESIS_PROFILE=gate $(PY) -m pytest -q -n $(JOBS) --dist loadscope --no-loadscope-reorder

types: $(STAMP)
	$(PY) -m mypy

style: $(STAMP)
	$(PY) -m ruff check $(SOURCES)
	$(PY) -m ruff format --check $(SOURCES)
	@$(PY) -m tests.tools.reach

check-notebooks: $(STAMP)
	$(PY) book/tools/pairs.py
	$(PY) book/tools/numerals.py
	$(PY) book/tools/scenarios.py
	$(PY) book/tools/ledger.py --check

regress: $(STAMP)
	$(PY) book/tools/regress.py --jobs $(JOBS)

$(PAGES): regress-%: $(STAMP)
	@$(PY) book/tools/regress.py $*

slow: $(STAMP)
	HYPOTHESIS_PROFILE=explore $(PY) -m pytest -q -m "slow or hypothesis"

outputs: $(STAMP)
	$(PY) book/tools/execute.py
	$(PY) book/tools/ledger.py

check-determinism: $(STAMP)
	$(PY) book/tools/execute.py --check $(CHAPTERS)

update-scenarios: $(STAMP)
	$(PY) book/tools/scenarios.py --update

check-portability: $(STAMP)
	OPENBLAS_CORETYPE=Nehalem NPY_DISABLE_CPU_FEATURES="X86_V4 X86_V3 AVX512_ICL AVX512_SPR" \
		HYPOTHESIS_PROFILE=gate $(PY) -m pytest -q -n $(JOBS) --ignore tests/book --ignore tests/tools
	$(PY) book/tools/regress.py --portable

test-versions: $(STAMP)
	@for which in $(VERSIONS); do \
		$(PY) -m uv venv --quiet --clear --seed --python "$(PYTHON)" _build/$$which \
		&& $(PY) -m uv pip install --quiet --python _build/$$which --resolution $$which \
			--editable ".[book,test]" --requirements requirements.in \
		&& HYPOTHESIS_PROFILE=gate _build/$$which/bin/python -m pytest -q -n $(JOBS) \
			-p no:cacheprovider --ignore tests/book --ignore tests/tools || exit 1; \
	done

studies: $(STAMP)
	$(PY) book/tools/studies.py

check-studies: $(STAMP)
	$(PY) book/tools/studies.py --check

bench: $(STAMP)
	mkdir -p data/bench
	$(PY) tests/bench/run.py

mutants: $(STAMP)
	$(PY) tests/tools/mutants.py --sample $(SAMPLE)

lab: $(STAMP)
	$(PY) book/tools/lab.py "$(LAB)"

lock: $(STAMP)
	$(PY) -m uv pip compile --quiet --system-certs --universal --fork-strategy fewest --python-version 3.11 --no-emit-index-url \
		--no-emit-find-links --no-header --no-annotate --generate-hashes \
		--extra book --extra test --extra logs --extra mutants --extra dask --extra mpi \
		pyproject.toml requirements.in --output-file requirements.txt

# An empty environment for each of the two files; its packages come from the network.
dist: $(STAMP)
	rm -rf dist
	$(PY) -m uv build --quiet --no-build-isolation --python $(PY) --out-dir dist .
	@for file in dist/*.whl dist/*.tar.gz; do \
		$(PY) -m uv run --quiet --system-certs --isolated --no-project --python "$(PYTHON)" \
			--with "./$$file" python tests/tools/readme.py || exit 1; \
	done

clean:
	find _build -mindepth 1 -maxdepth 1 -not -name lab -exec rm -rf {} + 2>/dev/null || true
	rm -rf dist book/_generated .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path "./$(VENV)/*" -prune -exec rm -rf {} +
