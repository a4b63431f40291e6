# Two commands for a newcomer: `make demo` and `make test`. Each sets up what it needs in .venv, pinned by constraints.txt.
PYTHON ?= python3
VENV ?= .venv
JOBS ?= 2
BIN := $(VENV)/bin
LIVE := tests/live tests/test_commissioning.py tests/unit/benchmarks/test_bench_start.py tests/unit/benchmarks/test_slow_core.py
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# Without a network pip would try again and again, and so would the pip that it starts to build with.
export PIP_RETRIES ?= 1
# Each process finds what an earlier one has compiled, also where the shell forbids it: tests start several hundred processes.
export PYTHONDONTWRITEBYTECODE :=
# What only a release needs, in an environment of its own.
TOOLS := $(VENV)-release/bin
RELEASE_TOOLS := cyclonedx-bom==7.5.0 pip-audit==2.10.1 pip-licenses==5.5.5 uv==0.13.9
UNREACHABLE := NewConnectionError|ConnectTimeoutError|NameResolutionError|ReadTimeoutError|ProxyError|connection broken
# What pip says is kept, and is shown unless it is that there is no network.
install = $(PIP) install --constraint constraints.txt --editable '.[$(1)]' 2>$(VENV)/pip.log || { \
	if grep -qE '$(UNREACHABLE)' $(VENV)/pip.log; \
	then echo "No package index is reachable, so $(VENV) cannot be set up: connect this machine, or set PIP_INDEX_URL to a mirror ($(VENV)/pip.log)." >&2; \
	else cat $(VENV)/pip.log >&2; fi; exit 2; }

.PHONY: demo test docs wheel hashes release audit check compiled live others rare campaign format clean

demo: $(VENV)/.installed-all
	@$(BIN)/sextant demo

# What is compiled is compiled once, for all. What is live has the machine when it wants it; the others take what is left until
# it is done.
test: compiled
	@touch $(VENV)/.live
	@$(MAKE) --no-print-directory --jobs=3 --keep-going check live others

# The site, from docs/; a warning is an error. It needs no network.
docs: $(VENV)/.installed-dev
	@$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going docs docs/_build/html
	@echo "docs/_build/html/index.html"

# A wheel that starts without compiling: with this Python, on the kind of machine that builds it (x86-64-v3, arm64).
wheel: $(VENV)/.installed-all
	@rm -rf build
	@SEXTANT_COMPILE=$(abspath $(BIN)/python) $(PIP) wheel --no-deps --wheel-dir dist .
	@ls dist/*.whl

# What the extra `all` needs, pinned as in constraints.txt, with the hash of each file that the package index has, for any platform.
hashes: $(TOOLS)/uv
	@$(TOOLS)/uv pip compile --quiet pyproject.toml --extra all --constraint constraints.txt --generate-hashes --universal \
		--python-version 3.11 --no-annotate --custom-compile-command "make hashes" --output-file requirements.txt

# dist/: the wheel, requirements.txt, SBOM, licences, the audit of known vulnerabilities, and SHA-256 sums. What is installed from them in
# an environment without anything else walks once.
release:
	@rm -rf dist
	@$(MAKE) --no-print-directory hashes wheel
	@cp requirements.txt dist
	@rm -rf build/bare && $(BIN)/python -m venv build/bare
	@build/bare/bin/python -m pip --quiet install --require-hashes --only-binary :all: --requirement dist/requirements.txt
	@build/bare/bin/python -m pip --quiet install --no-index --no-deps --find-links dist sextant
	@cd build/bare && bin/sextant --version && bin/sextant run steps --lockstep --seed 1000 --out walk
	@$(TOOLS)/cyclonedx-py environment build/bare/bin/python --pyproject pyproject.toml --output-reproducible --output-file dist/sbom.cdx.json
	@$(TOOLS)/pip-licenses --python build/bare/bin/python --from mixed --with-urls --format markdown --output-file dist/licences.md
	@$(MAKE) --no-print-directory audit
	@cd dist && sha256sum * > SHA256SUMS && ls

# Known vulnerabilities of what requirements.txt pins. An index that is only a mirror of packages may serve no list of them.
audit: $(TOOLS)/uv
	@mkdir -p build dist && rm -f dist/audit.*
	@$(TOOLS)/pip-audit --disable-pip --require-hashes --requirement requirements.txt --progress-spinner off \
		--format json --output dist/audit.json 2>build/audit.log || ! grep -q '"id":' dist/audit.json 2>/dev/null || \
		{ cat build/audit.log dist/audit.json; exit 1; }
	@grep -q '"vulns"' dist/audit.json 2>/dev/null || { rm -f dist/audit.json; \
		echo "Not audited: the package index serves no list of vulnerabilities here (build/audit.log)." | tee dist/audit.txt; }

live: $(VENV)/.installed-dev
	@trap 'rm -f $(VENV)/.live' EXIT; trap 'exit 130' INT TERM; $(BIN)/python -m pytest -q -m "live and not rare" $(LIVE)

others: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -m "not live and not rare" --ignore=tests/live -n $(JOBS) --dist loadfile --no-loadscope-reorder \
		--give-way=$(VENV)/.live

# What is rare and long: one test after the other, since some are live.
rare: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -q -m rare

# What README and docs claim and the present code has not shown: docs/evidence.md.
campaign: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks campaign --run --jobs $(JOBS) $(if $(HOURS),--hours $(HOURS))
	$(BIN)/python -m docs.reference results

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

compiled: $(VENV)/.installed-dev
	$(BIN)/python -m sextant.deploy.launch.warm_up

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) $(VENV)-release runs build dist docs/_build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer expected, found $$($(PYTHON) --version 2>&1); try: make PYTHON=python3.12 ..."; exit 2; }
	@$(PYTHON) -m venv $(VENV) || \
		{ echo "Could not make a virtual environment; on Debian and Ubuntu install python3-venv."; rm -rf $(VENV); exit 2; }

$(TOOLS)/uv: Makefile
	@$(PYTHON) -m venv $(VENV)-release
	@$(TOOLS)/python -m pip --disable-pip-version-check --quiet install $(RELEASE_TOOLS)
	@touch $@

$(VENV)/.installed-all: $(BIN)/python pyproject.toml constraints.txt
	@echo "Setting up $(VENV) (once, some minutes) ..."
	@$(call install,all)
	@touch $@

$(VENV)/.installed-dev: $(BIN)/python pyproject.toml constraints.txt
	@echo "Setting up $(VENV) with the development tools (once, some minutes) ..."
	@$(call install,dev)
	@touch $@ $(VENV)/.installed-all
