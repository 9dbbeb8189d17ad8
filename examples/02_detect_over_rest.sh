#!/usr/bin/env bash
# Grasps of a PLY file from a running server, with nothing but curl.
#
# usage: examples/02_detect_over_rest.sh cloud.ply [url]
set -euo pipefail

cloud=${1:?usage: $0 cloud.ply [url]}
url=${2:-http://127.0.0.1:8000}

curl --silent --show-error --fail-with-body \
    --header 'Content-Type: application/x-ply' \
    --data-binary "@$cloud" \
    "$url/v1/grasps?seed=0&top_k=5"
echo
