#!/bin/sh
# Regenerates what is generated of the interface: the Python stubs beside proto/edgegrasp/v1/*.proto,
# the contract beside them, and the OpenAPI document. Into proto/, or into the folder given.
# PYTHON names the interpreter that has the dev extra.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-$root/.venv/bin/python}
out=${1:-$root/proto}
PATH=$(dirname "$python"):$PATH # protoc looks there for the mypy plugins
"$python" -m grpc_tools.protoc --proto_path="$root/proto" \
    --python_out="$out" --grpc_python_out="$out" --mypy_out="quiet:$out" --mypy_grpc_out="quiet:$out" \
    "$root"/proto/edgegrasp/v1/*.proto
"$python" "$root/scripts/contract.py" "$out"
"$python" "$root/scripts/openapi.py" "$out"
