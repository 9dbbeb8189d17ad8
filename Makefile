# EdgeGrasp: `make help` lists the targets.
#
# PYTHON is the interpreter that makes .venv: make PYTHON=python3.12 venv
# TORCH are pip's arguments for PyTorch: a build without CUDA; with CUDA: make TORCH=torch venv

PYTHON ?= python3
TORCH ?= --no-deps --extra-index-url https://download.pytorch.org/whl/cpu torch
VENV := .venv
BIN := $(VENV)/bin
# Without precompiling: Python compiles modules when they are imported.
PIP := $(BIN)/python -m pip --disable-pip-version-check install --no-compile
INSTALLED := $(VENV)/.installed
# Marks that packages are installed: for `make view` only (quicker); for `make lint` and the like.
TO_LOOK := $(VENV)/.to_look
TOOLS := $(VENV)/.tools
GENERATED := $(wildcard proto/edgegrasp/*/*_pb2*) proto/edgegrasp/v1/contract.json \
	proto/edgegrasp/v1/openapi.json clients/edgegrasp_client/options.py

.DEFAULT_GOAL := help
.PHONY: help venv lint format test bench fuzz view demo docs image-test proto constraints clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

venv: $(INSTALLED) ## make .venv with what demo and test need, and the system libraries

$(INSTALLED): EXTRA := dev
$(TO_LOOK): EXTRA := service,view
$(INSTALLED) $(TO_LOOK): pyproject.toml constraints.txt scripts/system_packages.sh
	scripts/system_packages.sh $(PYTHON)
	$(PYTHON) -m venv $(VENV)
	$(PIP) --quiet --upgrade 'pip>=25.1' # shows a bar while it unpacks too
	$(PIP) --constraint constraints.txt $(TORCH)
	$(PIP) --constraint constraints.txt --editable '.[$(EXTRA)]'
	-[ $(EXTRA) != dev ] || \
		$(PIP) --constraint constraints.txt --editable '.[open3d]' # not for glibc < 2.35
	@touch $@

$(TOOLS): $(INSTALLED)
	$(PIP) --constraint constraints.txt --editable '.[tools]'
	@touch $@

lint: $(TOOLS) ## style, types, import boundaries, generated code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy $(wildcard examples/*.py)
	$(BIN)/mypy --python-version 3.10 --package edgegrasp_camera --package edgegrasp_client --package edgegrasp_results --module edgegrasp_bridge.bridge
	$(BIN)/lint-imports
	$(BIN)/hadolint Dockerfile
	$(BIN)/kubernetes-validate --strict --quiet docker/kubernetes/*.yaml
	$(BIN)/check-jsonschema --builtin-schema vendor.compose-spec docker/compose*.yaml
	mkdir -p build
	rm -f build/audit.json # pip-audit does not write it, and says so, if advisories are unreachable
	$(BIN)/pip-audit --progress-spinner off --disable-pip --require-hashes -r docker/requirements.txt \
		-f json -o build/audit.json || [ ! -e build/audit.json ]
	PYTHON=$(BIN)/python scripts/generate_proto.sh build
	set -e; for file in $(GENERATED); do cmp $$file build/$$file; done

format: $(TOOLS) ## rewrite the code in the project's style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

test: $(INSTALLED) ## run the tests, on every core
	$(BIN)/pytest -q -n auto

fuzz: $(INSTALLED) ## send invalid input to the decoders and to a running server, for some minutes
	$(BIN)/pytest -q tests/fuzz --hypothesis-profile=fuzz

bench: $(INSTALLED) ## measure speed; rewrites the tables of README and docs/speed.md
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.speed --pages
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/robot.py

view: $(or $(wildcard $(INSTALLED)),$(TO_LOOK)) ## look at a scene and its grasps in the browser: make view FILE=scene.npz
	$(BIN)/edgegrasp view $(FILE)

demo: $(INSTALLED) ## simulate a scene, find grasps over gRPC and REST, execute one, draw a picture
	$(BIN)/python examples/demo.py

docs: $(TOOLS) ## build the site of docs/ into build/site, without network; warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

image-test: $(INSTALLED) ## build the container image, run it unprivileged (root, Debian: podman)
	docker/test_image.sh $(BIN)/python

proto: $(TOOLS) ## generate gRPC code, contract, OpenAPI document and the client's options
	PYTHON=$(BIN)/python scripts/generate_proto.sh

constraints: ## resolve all dependencies again and write constraints.txt
	scripts/update_constraints.sh $(PYTHON)

clean: ## remove .venv and everything built or cached
	rm -rf $(VENV) build dist demo_output .mypy_cache .pytest_cache .ruff_cache .hypothesis
