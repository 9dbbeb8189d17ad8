#!/bin/sh
# Regenerates the Python messages beside proto/edgegrasp/*/*.proto, the stubs and the contract of
# edgegrasp.v1, the options in the OpenAPI document, and those of the Python client.
# Into this checkout, or into the same places under the folder given.
# PYTHON names the interpreter that has the dev extra.
set -eu
root=$(cd "$(dirname "$0")/.." && pwd)
python=${PYTHON:-$root/.venv/bin/python}
out=${1:-$root}
PATH=$(dirname "$python"):$PATH # protoc looks there for the mypy plugins
mkdir -p "$out/proto"
"$python" -m grpc_tools.protoc --proto_path="$root/proto" --python_out="$out/proto" \
    --mypy_out="quiet:$out/proto" "$root"/proto/edgegrasp/*/*.proto
"$python" -m grpc_tools.protoc --proto_path="$root/proto" --grpc_python_out="$out/proto" \
    --mypy_grpc_out="quiet:$out/proto" "$root"/proto/edgegrasp/v1/*.proto
"$python" "$root/scripts/contract.py" "$out/proto"
"$python" "$root/scripts/from_options.py" "$out"
