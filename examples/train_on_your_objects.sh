#!/usr/bin/env bash
# Weights for your objects: make data with them, train from the built-in weights, and benchmark the
# result.
#
# usage: examples/train_on_your_objects.sh OBJECTS OUTPUT [SCENES] [STEPS]
#
# OBJECTS: packed/train and packed/test, with .urdf files, or .obj or .stl files of any unit (extra meshes).
set -euo pipefail

objects=${1:?usage: $0 OBJECTS OUTPUT [SCENES] [STEPS]}
output=${2:?usage: $0 OBJECTS OUTPUT [SCENES] [STEPS]}
scenes=${3:-200} steps=${4:-400}
shipped=$(python3 -c 'from edgegrasp_model.detector import WEIGHTS_FOLDER as f; print(f)')

edgegrasp generate-data "$output/data" --objects "$objects" --scene packed --scenes "$scenes"
edgegrasp train "$output/data" --start-from "$shipped/edgegrasp-plus.safetensors" --keep 0.5 \
    --learning-rate 3e-4 --steps "$steps" --run "$output/run"
edgegrasp benchmark --planner in-process --model "$output/run/edgegrasp-plus.safetensors" \
    --objects "$objects" --scene packed --seed 0 --rounds "$((scenes / 10 + 1))" \
    --output "$output/benchmark"
