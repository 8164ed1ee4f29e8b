# `make demo` runs the main job, `make test` the tests; each makes the virtual environment by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
OUT ?= out/demo

.PHONY: demo test fuzz lint docs bench clean

$(STAMP): pyproject.toml weights/pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; \
	  sys.exit(0 if sys.version_info >= (3, 11) else f"roadproof needs Python 3.11 or newer, this is {v}: set PYTHON=...")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --group dev --editable ./weights \
	  --editable '.[blackbox,carla,chessboard,cil,onnx,ray,study,town,video]'
	touch $(STAMP)

# The whole loop on one scenario of the built-in town; given recorded drives of your own, they are attacked instead.
demo: $(STAMP)
ifdef RECORDINGS
	@test -n "$(CONTROLLER)" || { echo "make demo RECORDINGS=... also needs CONTROLLER=..., e.g. CONTROLLER=cil" >&2; exit 2; }
	$(BIN)/roadproof attack "$(RECORDINGS)" --controller "$(CONTROLLER)" --out "$(OUT)"
else
	$(BIN)/roadproof demo --processes 0 --out "$(OUT)"
endif

# A worker that crashes fails the run: restarted under --dist loadfile, it would wait for ever (pytest-xdist 1323).
# The order is the tests' own, the slow files first.
test: $(STAMP)
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile --no-loadscope-reorder --max-worker-restart 0

# The property tests of what comes from outside, a hundred times as long as in `make test`, and not the same again.
fuzz: $(STAMP)
	ROADPROOF_FUZZ=$(or $(TIMES),100) $(BIN)/python -m pytest tests/io/test_any_file.py tests/simulators/carla_server/test_requests.py

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/pyright --pythonpath $(BIN)/python --project .ci/scripts.json
	$(BIN)/lint-imports

# The documentation as a site that needs no network: out/docs/index.html. A warning is an error, and every page is read
# again: a link may miss in a page that has not changed.
docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --group docs
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --fresh-env --builder html docs out/docs

# What needs no development data; each file of benchmarks/ says how to run it.
bench: $(STAMP)
	mkdir -p out
	$(BIN)/python benchmarks/gradopt_step.py --json out/gradopt_step.json
	$(BIN)/python benchmarks/simulator_speed.py --json out/simulator_speed.json

clean:
	rm -rf $(VENV) build dist out docs/api
