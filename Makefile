# Every target sets up what it needs: a virtual environment in .venv and the compiled parts in build/.
# Needs a C compiler, make and Python 3.11 or newer with venv and headers
# (Debian, Ubuntu: gcc make python3-venv python3-dev).
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
SHELL := /bin/bash

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out
SCENARIO ?=

# What a change in compiled code or in its generators must rebuild.
NATIVE := CMakeLists.txt pyproject.toml \
  $(shell find dbc firmware plant_fmu bridge autonomy -name '*.c' -o -name '*.h' -o -name '*.def' -o -name CMakeLists.txt \
    -o -name '*.dbc' -o -path 'firmware/schema/*.yaml' -o -name 'generate.py' -o -name 'cffi_binding.py' \
    -o -path 'dbc/network.py' -o -path 'dbc/buses.py' -o -path 'firmware/tables.py' -o -path 'plant_fmu/*.py')

.PHONY: help
help: ## Show this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 16

$(BIN)/python:
	@command -v "$${CC:-cc}" >/dev/null || { echo 'raceloop needs a C compiler: apt install gcc'; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { echo 'raceloop needs Python 3.11 or newer; set PYTHON=python3.x'; exit 2; }
	@$(PYTHON) -c 'import ensurepip, sysconfig, os; assert os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h"))' 2>/dev/null \
	  || { echo 'raceloop needs the venv module and the headers of Python: apt install python3-venv python3-dev'; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.dependencies: pyproject.toml | $(BIN)/python
	$(BIN)/python -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb")); print(*p["build-system"]["requires"], "cmake", "ninja", *p["project"]["dependencies"], *p["project"]["optional-dependencies"]["dev"], sep="\n")' > $(VENV)/requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r $(VENV)/requirements.txt
	@touch $@

$(VENV)/.built: $(NATIVE) | $(VENV)/.dependencies
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --editable . \
	  --config-settings=cmake.define.RACELOOP_WERROR=ON
	@touch $@

.PHONY: build
build: $(VENV)/.dependencies $(VENV)/.built ## Compile codec, firmware, FMUs and bindings into .venv

.PHONY: run
run: build ## Drive the scenario (SCENARIO=FILE, default the solo lap) and write the recordings to OUT=out
	$(BIN)/raceloop run $(if $(SCENARIO),'$(SCENARIO)') --out '$(OUT)'

# A file's tests stay in one process. The order of the folders is kept: last come unit's many short files, not the few
# tests that drive laps, with which one worker would end alone.
WORKERS := -n 2 --dist loadfile --no-loadscope-reorder
# Those in real time run alone: they would measure the others. Collecting all files to find them takes its time.
REALTIME_FILES = $(shell grep -rl --include='test_*.py' 'pytest\.mark\.realtime' hil_tests)

.PHONY: test
test: build ## Run all tests
	$(BIN)/python -m pytest $(WORKERS) -m 'not realtime and not machine'
	$(BIN)/python -m pytest -m 'realtime and not machine' $(REALTIME_FILES)

.PHONY: test-vcan
test-vcan: build ## Run the SocketCAN tests: on this kernel if it has vcan, else on Debian's kernels under QEMU
	$(BIN)/python -m tools.vcan_machine

.PHONY: test-machine
test-machine: build ## Test the machine itself that the SocketCAN tests run in where this kernel has no vcan
	$(BIN)/python -m pytest -m machine hil_tests/contract/test_vcan_machine.py

.PHONY: matrix
matrix: build ## Run the whole reaction matrix: every fault by operating state and duration; the table to OUT/reactions
	$(BIN)/python -m pytest -q -n 2 --dist loadgroup -m matrix --reactions '$(OUT)/reactions' hil_tests/hil/test_reaction_matrix.py

.PHONY: bench
bench: build ## Measure this loop beside the plain loop a user would write, and each part of perception beside its peers
	$(BIN)/raceloop bench
	$(MAKE) --no-print-directory perception-bench

.PHONY: perception-bench
perception-bench: detection-bench lidar-bench ## Measure LiDAR model, detection, tracking and estimation beside their peers
	$(BIN)/python -m tools.tracking_bench
	$(BIN)/python -m tools.estimation_bench

$(VENV)/.peers: pyproject.toml | $(VENV)/.dependencies
	$(BIN)/python -c 'import tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]; print(*p["bench"], *p["peers"], sep="\n")' > $(VENV)/peers.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r $(VENV)/peers.txt
	@touch $@

.PHONY: detection-bench
detection-bench: build $(VENV)/.peers ## Measure LiDAR detection beside numpy, scipy and scikit-learn on the same scans
	$(BIN)/python -m tools.detection_bench

.PHONY: lidar-bench
lidar-bench: build ## Measure the spatial LiDAR model beside the same beams cast with numpy
	$(BIN)/python -m tools.lidar_bench

.PHONY: jitter
jitter: build ## Measure the onboard computer's cycle, idle and under load, beside cyclictest; results to OUT/jitter
	$(BIN)/raceloop jitter --seconds 60 --load all --out '$(OUT)/jitter'

.PHONY: check
check: lint types warnings coverage fuzz-short ## Format, lint, types, warnings as errors with each compiler present, the coverage gate, a little fuzzing

.PHONY: format
format: build ## Format all sources in place
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix --exit-zero --quiet .
	git ls-files '*.c' '*.h' | xargs $(BIN)/clang-format -i

.PHONY: lint
lint: build ## Check format and lint
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	git ls-files '*.c' '*.h' | xargs $(BIN)/clang-format --dry-run -Werror

.PHONY: types
types: build ## Check types
	$(BIN)/mypy

.PHONY: warnings
warnings: build ## Compile everything with warnings as errors, with gcc, clang and arm-none-eabi-gcc where present
	PATH="$(CURDIR)/$(BIN):$$PATH" tools/compile_all.sh

# A second environment holds the instrumented build; it borrows every dependency from the first.
.venv-coverage/.built: $(NATIVE) $(VENV)/.dependencies
	$(PYTHON) -m venv .venv-coverage
	$(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' > "$$(.venv-coverage/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/dependencies.pth"
	PATH="$(CURDIR)/$(BIN):$$PATH" .venv-coverage/bin/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --editable . \
	  --config-settings=cmake.define.RACELOOP_COVERAGE=ON --config-settings=cmake.build-type=Debug --config-settings=build-dir=build/coverage
	@touch $@

.PHONY: coverage
coverage: .venv-coverage/.built ## Run unit tests on instrumented firmware; SSM, parameter check, codec runtime and profiles need 100 % of lines and branches
	find build/coverage -name '*.gcda' -delete
	.venv-coverage/bin/python -m pytest -q $(WORKERS) hil_tests/unit/test_{ssm,parameter,codec,obc,dbw_profile}*.py
	$(BIN)/gcovr --root . --object-directory build/coverage --exclude-throw-branches \
	  --filter 'firmware/obc/ssm\.c' --filter 'firmware/obc/parameters\.c' --filter 'firmware/common/codec\.c' --filter 'firmware/common/dbw_profile\.c' \
	  --txt-metric branch --print-summary --fail-under-line 100 --fail-under-branch 100 build/coverage

MUTATE_TESTS ?= hil_tests/unit

.PHONY: mutate
mutate: build ## Plant small faults in the safety-relevant C, one at a time, and count those that the unit tests (MUTATE_TESTS) notice; goes on where it was stopped
	$(BIN)/python -m tools.mutation $(MUTATE_TESTS)

FUZZ_SECONDS ?= 60

.PHONY: fuzz
fuzz: build ## Run the fuzz targets (clang, ASan, UBSan) for FUZZ_SECONDS=60 each
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python hil_tests/fuzz/run.py --seconds $(FUZZ_SECONDS)

.PHONY: fuzz-short
fuzz-short: build ## Run the fuzz targets on the same few hundred inputs every time, where clang has libFuzzer
	@echo 'int LLVMFuzzerTestOneInput(void) { return 0; }' | clang -fsanitize=fuzzer,address -x c -o /dev/null - 2>/dev/null || \
	  { echo 'clang with libFuzzer: not present, not fuzzed'; exit 0; }; \
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python hil_tests/fuzz/run.py --runs 500

.PHONY: prove
prove: build ## Prove properties of the firmware with CBMC, and that each proof fails on a broken copy
	$(BIN)/python firmware/proofs/prove.py

.PHONY: misra
misra: build ## Check the C with cppcheck and MISRA C:2012; every finding needs its reason in firmware/misra.txt
	$(BIN)/python -m firmware.misra

# A third environment, as for coverage: gcc's AddressSanitizer and UndefinedBehaviorSanitizer in every C file.
SANITIZE := -O1 -g -fno-omit-frame-pointer -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all

.venv-sanitize/.built: $(NATIVE) $(VENV)/.dependencies
	$(PYTHON) -m venv .venv-sanitize
	$(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' > "$$(.venv-sanitize/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/dependencies.pth"
	PATH="$(CURDIR)/$(BIN):$$PATH" CC=gcc .venv-sanitize/bin/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps --editable . \
	  '--config-settings=cmake.define.CMAKE_C_FLAGS=$(SANITIZE)' --config-settings=cmake.build-type=Debug --config-settings=build-dir=build/sanitize
	@touch $@

SANITIZE_TESTS ?= hil_tests/unit hil_tests/contract
# ASan takes SIGSEGV for itself, and leaves mlockall out.
SANITIZE_NOT := --deselect 'hil_tests/unit/test_supervisor.py::test_a_part_that_is_killed[11]' \
  --deselect hil_tests/unit/test_realtime.py::test_memory_is_locked_or_the_line_says_how_to_allow_it

.PHONY: sanitize
sanitize: .venv-sanitize/.built ## Run unit and contract tests (SANITIZE_TESTS) on C built with ASan and UBSan
	tools/check_sanitized.sh build/sanitize
	LD_PRELOAD="$$(gcc -print-file-name=libasan.so):$$(gcc -print-file-name=libubsan.so)" ASAN_OPTIONS=detect_leaks=0 \
	  UBSAN_OPTIONS=print_stacktrace=1 .venv-sanitize/bin/python -m pytest -q $(WORKERS) -m 'not realtime and not machine' $(SANITIZE_NOT) $(SANITIZE_TESTS)

.PHONY: clean
clean: ## Remove everything that was built
	rm -rf build .venv .venv-coverage .venv-sanitize .mypy_cache .ruff_cache out
