# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
RUN := $(VENV)/bin/python

.PHONY: demo test check clean

demo: $(VENV)/ready  ## the ablation sweep on the built-in clips, 2 to 6 minutes on 2 cores
	$(RUN) -m orchestrator.sweep sweeps/ablation.yaml scale=demo

test: $(VENV)/ready  ## the default suite
	$(RUN) -m tests.compile
	OMP_NUM_THREADS=1 $(RUN) -m pytest -n 3 --dist loadfile --no-loadscope-reorder  # three share the cores

check: $(VENV)/ready  ## style
	$(RUN) -m ruff check .

# constraints.txt holds the exact versions that the tests ran with (torch: the CPU build where an index offers it)
$(VENV)/ready: pyproject.toml constraints.txt
	test -x $(RUN) || $(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --disable-pip-version-check torch==$$(sed -n 's/^torch==//p' constraints.txt)
	$(RUN) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	touch $@

clean:
	rm -rf $(VENV) build *.egg-info
