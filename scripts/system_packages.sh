#!/usr/bin/env bash
# Make sure the system has what pip cannot install: Python's venv module, and the shared libraries
# that MuJoCo and Open3D load. Installs them where it may (root, with apt-get), and otherwise names
# the command to run.
#
# usage: scripts/system_packages.sh [python]
set -euo pipefail

python=${1:-python3}

if ! command -v "$python" >/dev/null; then
    echo "error: no '$python' on this machine. Install Python 3.11 or newer, or name another:" \
        "make PYTHON=/path/to/python3 venv" >&2
    exit 1
fi
if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
    echo "error: '$python' is $("$python" -V). EdgeGrasp needs Python 3.11 or newer; name it with" \
        "make PYTHON=python3.11 venv" >&2
    exit 1
fi

missing=()

if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    missing+=("$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')")
fi

# A library is there if the dynamic loader finds it, whoever installed it.
can_load() {
    "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "$1" 2>/dev/null
}

if [ "$(uname -s)" = Linux ]; then
    while read -r library package; do
        can_load "$library" || missing+=("$package")
    done <<'LIBRARIES'
libGL.so.1 libgl1
libEGL.so.1 libegl1
libX11.so.6 libx11-6
libusb-1.0.so.0 libusb-1.0-0
libgomp.so.1 libgomp1
LIBRARIES
fi

if [ ${#missing[@]} -eq 0 ]; then
    exit 0
fi

echo "missing system packages (names as on Debian): ${missing[*]}"

if ! command -v apt-get >/dev/null; then
    echo "warning: no apt-get here; install them with this system's own tool. Without the" \
        "libraries, MuJoCo draws no images, and Open3D (benchmarks and tests) does not import." >&2
    exit 0
fi

if [ "$(id -u)" -ne 0 ]; then
    echo "error: not root, so not installing them. Run this, then make again:" >&2
    echo "    sudo apt-get update && sudo apt-get install -y --no-install-recommends ${missing[*]}" >&2
    exit 1
fi

export DEBIAN_FRONTEND=noninteractive
# One unreachable source must not stop the others from serving these packages.
apt-get update -q || echo "warning: apt-get update failed; trying with the lists at hand" >&2
apt-get install -q -y --no-install-recommends "${missing[@]}"
