#!/usr/bin/env bash
# Resolve every dependency afresh in a throw-away environment and write the exact versions to
# constraints.txt, and those of the image with hashes to docker/requirements.txt. Run it after changing a
# dependency in pyproject.toml.
#
# usage: scripts/update_constraints.sh [python]
set -euo pipefail

cd "$(dirname "$0")/.."
python=${1:-python3}
environment=build/constraints-venv

# The resolver would take the newest torch; this is the one that is tested, and the build without
# CUDA carries the same version number.
torch=2.13.0

rm -rf "$environment"
"$python" -m venv "$environment"
"$environment/bin/pip" install --quiet --constraint <(echo "torch==$torch") --editable '.[open3d,tools]'

# A local version label (+cpu) names one build; CUDA's own packages come with the other build.
{
    echo "# Exact versions of everything '.[open3d,tools]' installs; written by scripts/update_constraints.sh."
    "$environment/bin/pip" freeze --all --exclude-editable --exclude pip --exclude wheel |
        sed -e 's/+cpu$//' |
        grep -v -i -E '^(nvidia-|cuda-|triton==)'
} >build/constraints.txt
mv build/constraints.txt constraints.txt
echo "constraints.txt: $(grep -c == constraints.txt) packages"

# For the image, with the hash of every file; torch has builds of its own, and is installed before.
"$environment/bin/pip" install --quiet uv
"$environment/bin/python" - >build/requirements.in <<PYTHON
import tomllib

project = tomllib.load(open("pyproject.toml", "rb"))["project"]
extras = [project["optional-dependencies"][name] for name in ("cli", "files", "model", "service")]
named = sum(extras, project["dependencies"])
print(*(one for one in named if not one.startswith(("edgegrasp", "torch"))), sep="\n")
PYTHON
{
    echo "# What the image installs beside torch; written by scripts/update_constraints.sh."
    "$environment/bin/uv" pip compile --quiet --universal --python-version 3.11 --generate-hashes \
        --no-header --no-annotate --constraint constraints.txt build/requirements.in
} >build/requirements.txt
mv build/requirements.txt docker/requirements.txt
