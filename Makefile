# Everything runs in .venv; nothing else on the machine is touched.
# The first of these that is new enough; another one: make PYTHON=/path/to/python3.11
PYTHONS := python3 python3.14 python3.13 python3.12 python3.11
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for python in $(PYTHONS); do \
	$$python -c '$(NEW_ENOUGH)' 2>/dev/null && echo $$python && break; done)
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --editable

# Hundreds of processes are started: what is compiled of us is kept, whatever the shell says.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo firmware firmware-test qemu-test test test-changed test-long test-busy test-kernels test-pymodbus nightly lint weigh pages pictures format docs fuzz faults mutants kill-test fault-test stop-test late-test qt-test estimate-test surface-test soak bench bench-latency \
	bench-promise dist kernels smoke smoke-lowest sbom licences clean
.NOTPARALLEL:

demo: .venv/installed
	$(BIN)/era demo

# An amplifier in C for this machine, in out/firmware; firmware/README.md tells the rest.
firmware:
	$(MAKE) -C firmware

# The tests of the firmware, damaged frames under sanitizers, and its sizes; 200 000 frames a line:
# make firmware-test FIRMWARE=--long
firmware-test: .venv/installed-test
	.ci/install gcc-arm-none-eabi:arm-none-eabi-gcc libnewlib-arm-none-eabi:
	$(BIN)/python firmware/test/run.py $(FIRMWARE)

# Full conformance of the firmware on an emulated microcontroller, on its serial and its Modbus RTU line.
qemu-test: .venv/installed-test
	.ci/install qemu-system-arm:qemu-system-arm gcc-arm-none-eabi:arm-none-eabi-gcc libnewlib-arm-none-eabi:
	$(BIN)/python tests/programs/emulated_board.py

# First the tests that mostly compute, then those that play in real time, from the files that name them.
# Each with one worker more than there are processors: some tests wait for processes. More workers make
# the second part no faster, and its deadlines harder to meet. Tests that load the processors
# themselves are in `make test-long`.
WORKERS = $(shell $(PYTHON) -c 'import os; print((os.cpu_count() or 1) + 1)')
# A test that never ends is one failure, which says where it was; a worker begun anew would wait for ever.
ENDING := -o faulthandler_timeout=400 -o faulthandler_exit_on_timeout=true --max-worker-restart 0
test: .venv/installed-test
	$(BIN)/pytest $(ENDING) -m 'not real_time and not long' --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder
	$(BIN)/pytest $(ENDING) -m 'real_time and not long' --numprocesses $(WORKERS) --dist loadfile --no-loadscope-reorder $$(grep -rl real_time tests --include='test_*.py')

# The tests nearest to what differs from main: within a minute, stopping at the first failure.
# Since another commit: make test-changed SINCE=HEAD~3
test-changed: .venv/installed-test
	$(BIN)/python tests/programs/changed_tests.py $(if $(SINCE),--since $(SINCE))

# All that is long, one target after another, in at most three hours; the results are in
# out/nightly/page.md. Others: make nightly NIGHTLY='soak kill-test', or NIGHTLY_OPTIONS=--report
NIGHTLY := test-long test-kernels test-pymodbus test-busy faults mutants firmware-test qemu-test fuzz stop-test late-test kill-test soak qt-test estimate-test surface-test smoke-lowest weigh
nightly: .venv/installed-test
	$(BIN)/python tests/programs/nightly.py $(NIGHTLY) $(NIGHTLY_OPTIONS)

# Whole programmes of which `make test` has a short form: every command of the pages typed from an
# empty folder, conformance of the examples, an identified plate; and those
# cases of heavy tests that `make test` leaves out.
test-long: .venv/installed-test
	.ci/install caddy:caddy nginx:nginx openssl:openssl calculix-ccx:ccx
	$(BIN)/pytest --verbose -m 'long and not alone' --numprocesses auto
	$(BIN)/pytest --verbose -m 'long and alone'

# A short form of the whole suite on a machine that has no time: what talks to wires, processes and
# clients, beside six processes that compute without pause.
BUSY := tests/drivers tests/firmware \
	tests/controller/daemon tests/controller/gateway tests/controller/api tests/integration
test-busy: .venv/installed-test
	@busy=; for _ in 1 2 3 4 5 6; do $(BIN)/python -c 'while True: pass' & busy="$$busy $$!"; done; \
		trap "kill $$busy" EXIT; trap exit INT TERM; \
		$(BIN)/pytest -m 'not long' --numprocesses 2 --dist loadfile --no-loadscope-reorder $(BUSY)

# The model's tests, the typed pages and the demonstration with the arithmetic of four kinds of
# processor, and what differs between their answers; four minutes. Others: make test-kernels KERNELS=--answers
test-kernels: .venv/installed-test
	$(BIN)/python tests/programs/kernels.py $(KERNELS)

# What reads and writes Modbus, with the lowest and the newest pymodbus that the bounds allow, each in
# a folder of its own. Others: make test-pymodbus PYMODBUS=3.12.1
PYMODBUS := 3.8.* 3.*
MODBUS := tests/drivers/wires tests/era_haptics/lab/conformance tests/sim
test-pymodbus: .venv/installed-test
	@set -f; for version in $(PYMODBUS); do \
		folder="$(CURDIR)/out/pymodbus-$$version"; rm -rf "$$folder"; export PYTHONPATH="$$folder"; \
		$(BIN)/python -m pip --disable-pip-version-check install -qq --no-deps --target "$$folder" \
			"pymodbus==$$version" && \
		$(BIN)/python -c 'import pymodbus; print("pymodbus", pymodbus.__version__)' && \
		$(BIN)/pytest -q -m 'not long' --numprocesses 2 -k 'modbus or rtu or tcp' $(MODBUS) || exit 1; \
	done

lint: .venv/installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/mypy
	$(BIN)/python tests/support/checks/vocabulary.py
	$(BIN)/python tests/support/checks/unique_names.py
	$(BIN)/python tests/support/checks/english.py
	$(PAGES) --check

# Weight and density of the tree, for reviewers; nothing fails on them. One folder: make weigh WEIGH=controller
weigh: .venv/installed-test
	$(BIN)/python tests/programs/weigh.py $(WEIGH)

# Every page, part of a page, client stub and C header that is written from the code.
PAGES := OPENBLAS_NUM_THREADS=1 $(BIN)/python docs/generators/pages.py
pages: .venv/installed-test
	$(PAGES)

# The pictures that simulations draw, the moving one of the README among them; three minutes.
pictures: .venv/installed-test
	$(BIN)/python docs/generators/time_pictures.py docs/pictures
	$(BIN)/python docs/generators/moving_picture.py docs/pictures/car_display.webp

# A million damaged frames on every kind of line; `make test` takes a few thousand.
fuzz: .venv/installed-test
	FRAMES=1000000 $(BIN)/pytest -q tests/drivers/wires/test_frames.py

# Every planted fault (tests/faults) in a copy of the tree, with the tests that must find it. List those
# that no test of `make test` finds: make faults FAULTS=--nightly.
# Others: make faults FAULTS='--only wires/ --json out/faults.json'
faults: .venv/installed-test
	$(BIN)/python tests/faults/run.py $(FAULTS)

# Random changes of the code, and which of them the nearest tests notice; at most 20 minutes.
# Others: make mutants MUTANTS='--package drivers --count 50 --seed 3'
MUTANTS := --count 10 --minutes 20
mutants: .venv/installed-test
	$(BIN)/python tests/faults/mutants.py $(MUTANTS)

# Two hundred daemons killed at random moments, over every wire, and when all was silent;
# `make test` takes eight. Others: make kill-test KILLS='--kills 20 --seed 7'
kill-test: .venv/installed-test
	$(BIN)/python tests/programs/kills.py $(KILLS)

# Faults of the daemon, each by the real process, with the figures measured.
fault-test: .venv/installed-test
	$(BIN)/pytest -q -s tests/integration/test_daemon_faults_*.py

# Ten thousand stops while frames are lost, late and doubled, two thousand with an exception on
# their way, and as many by command after a killed host; `make test` takes some hundreds. Others: make stop-test STOPS=100000 FIRST=7
STOPS := 10000
FIRST := 0
stop-test: .venv/installed-test
	STOPS=$(STOPS) FIRST=$(FIRST) $(BIN)/pytest -q tests/drivers/host/test_group.py -k stop_is_true

# Ten thousand taps while every frame is late by up to 16 ms, with one and three amplifiers on a line;
# `make test` takes some. Others: make late-test LATE='--taps 100000'
late-test: .venv/installed-test
	$(BIN)/python tests/programs/late_taps.py $(LATE)

# The Qt application of the examples with PySide6, without a screen.
qt-test: .venv/installed-qt
	$(BIN)/pytest -q tests/integration/test_qt_application.py

# The whole chain in virtual time, by as many seeds as 20 minutes allow; `make test` takes seven.
# Others: make soak SOAK='--minutes 10 --wire serial', or one again: make soak SOAK='--seed 17'
soak: .venv/installed-test
	$(BIN)/python tests/programs/soak.py $(SOAK)

# True errors of responses in polynomials against their estimates, on 23 plates with 20 layouts;
# some minutes. `make test` takes one plate with four.
estimate-test: .venv/installed-test
	OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/programs/error_estimates.py

# A curved glass by the modes that CalculiX computes, against its whole equations; some minutes.
# Others: make surface-test SURFACE='--sets 200'
surface-test: .venv/installed-test
	.ci/install calculix-ccx:ccx
	$(BIN)/python -m benchmarks.surface --solver calculix --sets 30 $(SURFACE)

format: .venv/installed-test
	$(BIN)/ruff check --fix --exit-zero --quiet .
	$(BIN)/ruff format .
	$(BIN)/ruff check .

# Five minutes. Programs take turns, so that other load affects all of them.
bench: .venv/installed-peers
	$(BIN)/python -m benchmarks.plate --report

# Ten minutes, on a machine that is left alone.
bench-latency: .venv/installed-test
	$(BIN)/python -m benchmarks.latency --report

# Promised and felt contrast through the complete signal chain; hours on two cores.
# Others: make bench-promise PROMISE='--cases 0 --plates 8', or PROMISE=weather
bench-promise: .venv/installed
	$(BIN)/python -m benchmarks.promise $(PROMISE)

# The pages as a site, with warnings as errors; nothing in it comes from elsewhere.
docs: .venv/installed-docs
	$(BIN)/sphinx-build -b html -W --keep-going -q docs docs/_build/html
	! grep -rlE --include='*.html' '<(script|link|img|iframe)[^>]+(src|href)="(https?:)?//' docs/_build/html
	@echo "Next: open docs/_build/html/index.html"

# The sdist, and a wheel for machines like this one with the compiled C libraries; without a C compiler, a
# wheel for any machine. The same compiler makes the same bytes of the same sources; from a clean checkout.
dist: .venv/installed-release
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*

# The wheel alone, in a clean environment for each of python3.11 to python3.14 that is found.
# Others: make smoke SMOKE='--python /path/to/python3.13'
smoke: dist
	$(BIN)/python tests/programs/smoke.py dist/*.whl $(SMOKE)

# The same with the lowest version of every dependency that its bound allows.
smoke-lowest: dist
	$(BIN)/python tests/programs/smoke.py dist/*.whl --python python3.11 --lowest $(SMOKE)

# What comes with the wheel, as CycloneDX: dist/sbom.json of the plain installation, and
# dist/sbom-extras.json with those extras that users install.
sbom: dist
	for extras in '' '-extras'; do \
		rm -rf out/clean && $(PYTHON) -m venv out/clean && \
		out/clean/bin/python -m pip install -qq "$$(ls dist/*.whl)$${extras:+[gateway,cluster,sound,frames]}" && \
		out/clean/bin/python -m pip uninstall -qq --yes pip setuptools && \
		$(BIN)/cyclonedx-py environment --output-reproducible --validate \
			-o dist/sbom$$extras.json out/clean || exit 1; \
	done

licences: sbom
	$(BIN)/python tests/programs/licences.py dist/sbom.json dist/sbom-extras.json > docs/reference/licences.md

clean:
	rm -rf model/compiled/*.so sim/soft_amp/*.so
	rm -rf .venv dist docs/_build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache out

# A half-made environment is taken away, or the next run would take it for a whole one.
$(BIN)/python:
	@python="$(PYTHON)"; $${python:-false} -c '$(NEW_ENOUGH)' || { \
		echo "era-haptics needs Python 3.11 or newer; tried: $${python:-$(PYTHONS)}." >&2; \
		echo "Install one, then: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@echo "Creating the environment .venv"
	@$(PYTHON) -m venv .venv || { rm -rf .venv; \
		echo "No environment could be made; Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }

# The C libraries for this processor, if their sources have changed; without a C compiler, numpy computes.
kernels: $(BIN)/python
	@$(BIN)/python build_libraries.py

.venv/installed: $(BIN)/python pyproject.toml | kernels
	@echo "Installing era-haptics and 36 packages into .venv: 81 MB of downloads, 382 MB on disk,"
	@echo "about a minute besides the downloads. Nothing outside .venv is changed."
	$(PIP) .
	touch $@

.venv/installed-test: $(BIN)/python pyproject.toml | kernels
	@echo "Installing era-haptics and the test tools into .venv: 790 MB on disk, some minutes."
	$(PIP) '.[test]'
	touch $@ .venv/installed

.venv/installed-qt: .venv/installed-test
	$(PIP) '.[test,qt]'
	touch $@

.venv/installed-docs: $(BIN)/python pyproject.toml | kernels
	$(PIP) '.[docs]'
	touch $@ .venv/installed

.venv/installed-release: $(BIN)/python pyproject.toml | kernels
	$(PIP) '.[release]'
	touch $@ .venv/installed

.venv/installed-peers: $(BIN)/python pyproject.toml | kernels
	$(PIP) '.[peers]'
	touch $@ .venv/installed
