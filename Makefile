# `make demo` and `make test` set up all they need on a fresh Debian 12, once, and then do their work.

VENV := .venv
PYTHON := $(VENV)/bin/python
PIP := $(VENV)/bin/pip install --quiet --disable-pip-version-check
SUDO := $(if $(filter 0,$(shell id -u)),,sudo)
DEBIAN := redis-server cmake ninja-build g++ ccache libopenvdb-dev libboost-dev libboost-iostreams-dev \
	libimath-dev libopenexr-dev libopenimageio-dev libtbb-dev libgtest-dev \
	clang-format pkg-config python3-venv python3-dev
# What the slow tests alone ask for: a browser, a Slurm cluster, containers, a systemd of its own,
# OpenVDB's writer of odd caches, and Clang's fuzzer.
SLOW := clang libclang-rt-dev chromium prometheus slurmctld slurmd slurm-client munge buildah \
	debootstrap systemd systemd-container openssl python3-openvdb podman podman-compose crun netavark \
	aardvark-dns iptables
CORE := $(shell find core -type f -not -path '*/build/*' -not -name '*.pyc')
JOBS := $(shell nproc)

# Installs what is missing of a list of packages.
define install
@for package in $(1); do \
    dpkg-query -W -f '$${Status}\n' $$package 2>/dev/null | grep -q 'ok installed' || missing="$$missing $$package"; \
done; \
if [ -n "$$missing" ]; then \
    $(SUDO) apt-get update -qq && \
    $(SUDO) env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $$missing; \
fi
endef

.PHONY: demo test test-slow chart chart-small peers lint setup clean

demo: setup
	$(PYTHON) -m pileus_worker.demo

test: lint build/.built
	ctest --test-dir build --output-on-failure --parallel $(JOBS)
	$(PYTHON) -m pytest

test-slow: lint build/.built $(VENV)/.slow sanitize
	ctest --test-dir build --output-on-failure --parallel $(JOBS)
	$(PYTHON) -m pytest -m ''

# About half an hour; writes the page. Real caches are taken from ../shared/data, where there are any.
chart: setup peers
	$(PIP) --editable '.[bench]'
	$(VENV)/bin/pileus chart --full --peers --repeats 2 --out chart --page docs/speed-and-accuracy.md

chart-small: setup peers
	$(PIP) --editable '.[bench]'
	$(VENV)/bin/pileus chart --peers --out chart

# In an environment of their own: they need other versions of what Pileus uses.
peers: $(VENV)/peers/.installed

$(VENV)/peers/.installed: pyproject.toml $(VENV)/.venv
	$(call install,libllvm19)
	python3 -m venv $(VENV)/peers
	$(VENV)/peers/bin/pip install --quiet --disable-pip-version-check '.[peers]'
	@touch $@

lint: setup
	$(VENV)/bin/ruff check service worker bench tests
	$(VENV)/bin/ruff format --check service worker bench tests
	$(VENV)/bin/mypy
	find core -name '*.cpp' -o -name '*.h' -o -name '*.inc' | xargs clang-format --dry-run --Werror

setup: $(VENV)/.system $(VENV)/.core $(VENV)/.pileus

$(VENV)/.system: Makefile
	$(call install,$(DEBIAN))
	@mkdir -p $(VENV) && touch $@

$(VENV)/.slow: Makefile $(VENV)/.system
	$(call install,$(SLOW))
	@touch $@

$(VENV)/.venv: $(VENV)/.system
	test -x $(PYTHON) || python3 -m venv $(VENV)
	@touch $@

$(VENV)/.core: $(CORE) $(VENV)/.venv
	CMAKE_BUILD_PARALLEL_LEVEL=$(JOBS) $(PIP) ./core
	@touch $@

$(VENV)/.pileus: pyproject.toml $(VENV)/.core
	$(PIP) --editable '.[worker,denoise,dev]'
	@touch $@

.PHONY: stability
# About ten minutes; writes docs/stability.md.
stability: setup
	PYTHONPATH=tests $(PYTHON) -m stability

build/.built: $(CORE) $(VENV)/.system
	cmake -S core -B build -G Ninja
	cmake --build build --parallel $(JOBS)
	@touch $@

.PHONY: sanitize
# The core's tests under the address and the undefined behaviour sanitizers, and renders by several
# threads under the thread sanitizer; ten minutes the first time. The sanitizer's dlopen does not look
# where the caller's RUNPATH says, so the texture reader is to be found by LD_LIBRARY_PATH. One test is left
# out: of false counts OpenVDB asks for memory that nobody has, and the sanitizer's `new` then ends the program
# where the library's throws; it also reads a file's bytes as bools.
sanitize: $(VENV)/.system
	cmake -S core -B build/address -G Ninja -DCMAKE_BUILD_TYPE=None -DPILEUS_SANITIZE=address,undefined
	cmake --build build/address --parallel $(JOBS)
	LD_LIBRARY_PATH=$(CURDIR)/build/address LSAN_OPTIONS=suppressions=$(CURDIR)/core/tests/leak.supp \
	    ctest --test-dir build/address --exclude-regex RefusesCountsBeyondTheFile \
	    --output-on-failure --parallel $(JOBS)
	cmake -S core -B build/thread -G Ninja -DCMAKE_BUILD_TYPE=None -DPILEUS_SANITIZE=thread
	cmake --build build/thread --target pileus_threads_test --parallel $(JOBS)
	TSAN_OPTIONS=suppressions=core/tests/thread.supp build/thread/pileus_threads_test

clean:
	rm -rf $(VENV) build demo chart
