#!/bin/sh
# Regenerates the Python messages beside proto/edgegrasp/*/*.proto, the stubs and the contract of
# edgegrasp.v1, the options in the OpenAPI document, and those of the Python client.
# Fails if edgegrasp.v1 would break its callers; such a change goes to v2.
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
contract=edgegrasp/v1/contract.json # everything that was ever promised
buf breaking "$root/proto" --against "$root/proto/$contract"
buf build "$root/proto" --path "$root/proto/edgegrasp/v1" --exclude-source-info \
    --output "-#format=json" | "$python" -m json.tool --indent 1 >"$out/proto/$contract.new"
mv "$out/proto/$contract.new" "$out/proto/$contract"
"$python" "$root/scripts/from_options.py" "$out"
