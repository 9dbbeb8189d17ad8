#!/usr/bin/env bash
# Build the image on a base made here, and run it as a careful operator would: a read-only root, no
# rights, no network. Prints its size, its start, its memory, and its time beside this machine's own.
#
# usage: docker/test_image.sh [python]    of an environment with the service, to compare with
#
# TORCH: what pip is to install as torch, see the Dockerfile.
# PLATFORM: linux/arm64 or linux/amd64 in the place of this machine's own; another's needs qemu-user and binfmt.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/bare_debian.sh
python=${1:-python3}

skip() {
    echo "image-test: skipped: $1"
    exit 0
}
[ "$(id -u)" = 0 ] || skip "building images as another user than root is not tried"
packages="podman buildah runc debootstrap containernetworking-plugins uidmap"
for program in apt-get podman buildah runc debootstrap; do
    command -v $program >/dev/null ||
        skip "no $program here; on Debian: apt-get install --no-install-recommends $packages"
done

platform=${PLATFORM:-linux/$(dpkg --print-architecture)}
architecture=${platform#linux/}
if [ "$architecture" != "$(dpkg --print-architecture)" ]; then
    case $architecture in arm64) emulator=qemu-aarch64 ;; *) emulator=qemu-x86_64 ;; esac
    [ -e /proc/sys/fs/binfmt_misc/$emulator ] ||
        skip "the kernel runs no $architecture programs here; on Debian: apt-get install qemu-user-static"
fi

work=$(mktemp -d)
name=edgegrasp-test-$$
trap 'podman rm -f $name >/dev/null 2>&1; kill "${server:-}" 2>/dev/null; rm -rf "$work"' EXIT

# runc: crun refuses machines with both kinds of cgroups. Limits: podman asks for more than a machine
# may let it have.
processes=$(ulimit -Hu)
[[ $processes != unlimited && $processes -lt 32768 ]] || processes=32768
export CONTAINERS_CONF=$work/containers.conf
cat >"$CONTAINERS_CONF" <<CONF
[containers]
default_ulimits = ["nofile=$(ulimit -Sn):$(ulimit -Sn)", "nproc=$processes:$processes"]
[engine]
runtime = "runc"
cgroup_manager = "cgroupfs"
CONF

base=localhost/edgegrasp-base-$architecture
if ! podman image exists "$base"; then
    bare_debian "$work/base" python3,python3-venv,ca-certificates
    # As the slim images do.
    rm -rf "$work"/base/usr/share/{doc,info,locale,man}/* "$work"/base/var/{cache/apt,lib/apt/lists}/*
    tar -C "$work/base" -c . | podman import --quiet --arch "$architecture" - "$base"
    rm -rf "$work/base"
fi

# pip looks where this machine's does: its settings as a file, and the files and folders they name.
mounts=()
pip_settings "$work/pip.conf"
for path in $(pip_paths "$work/pip.conf"); do
    mounts+=(--volume "$path:$path:ro")
done
torch=${TORCH:-}
if [ -z "$torch" ] && grep -q '^find-links' "$work/pip.conf"; then
    torch="--no-deps torch" # a build of this machine's own
fi
buildah bud --quiet --format docker --isolation chroot --layers --tag localhost/edgegrasp \
    --platform "$platform" --build-arg "BASE=$base" --build-arg VERSION="$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)" \
    ${torch:+--build-arg "TORCH=$torch"} \
    --volume "$work/pip.conf:/etc/pip.conf:ro" "${mounts[@]}" . >"$work/log" 2>&1 ||
    { tail -n 40 "$work/log" && exit 1; }
mounted=$(podman image mount localhost/edgegrasp)
echo "size, unpacked: $(du -s --block-size=MB "$mounted" | cut -f 1)"
du -s --block-size=MB "$mounted"/venv/lib/python3*/site-packages/* | sort -rn | head -n 8 |
    sed "s,$mounted.*/,," | tr '\t\n' ' ;' && echo
podman image unmount localhost/edgegrasp >/dev/null

fail() {
    echo "image-test: $1" >&2
    podman logs --tail 20 $name >&2
    exit 1
}
begun=$(date +%s.%N)
podman run --detach --name $name --read-only --tmpfs /tmp --cap-drop ALL --network none \
    --security-opt no-new-privileges --memory 4g --pids-limit 512 \
    localhost/edgegrasp --workers 2 >/dev/null 2>"$work/log" || { cat "$work/log" && exit 1; }
until podman healthcheck run $name >/dev/null 2>&1; do
    [ "$(podman inspect --format '{{.State.Running}}' $name)" = true ] || fail "it died"
    sleep 0.2
done
awk "BEGIN { printf \"start: %.1f s\n\", $(date +%s.%N) - $begun }"
[ "$(podman exec $name id -u)" = 10001 ] || fail "it runs as another user"
! podman exec $name touch /venv/file 2>/dev/null || fail "its root can be written"
[ "$(podman exec $name ls /sys/class/net)" = lo ] || fail "it has a network"
! podman exec $name sh -c 'command -v cc gcc ld clang pip' || fail "it has a compiler or pip"

"$python" -P -c 'from edgegrasp_cli.main import main; main()' serve --workers 2 --log-level error \
    --http-port 18977 --grpc-port 18978 >/dev/null &
server=$!
"$python" docker/ask.py http://127.0.0.1:18977 127.0.0.1:18978 >/dev/null
for _ in 1 2 3; do # in turns: other work on the machine meets both
    echo "here: $("$python" docker/ask.py http://127.0.0.1:18977 127.0.0.1:18978) ms"
    echo "container: $(podman exec --interactive $name \
        python - http://127.0.0.1:8000 127.0.0.1:50051 <docker/ask.py) ms"
done
echo "memory: $(podman stats --no-stream --format '{{.MemUsage}}' $name)"

answered() {
    podman logs $name 2>&1 | grep -c -E '"code": "(OK|200)"'
}
# Requests that are in it when it is told to stop are answered.
before=$(answered)
for _ in 1 2 3 4; do
    podman exec --detach --interactive $name python -c "$(sed 's/^assert.*//' docker/ask.py)" \
        http://127.0.0.1:8000 127.0.0.1:50051 1000 >/dev/null
done
for _ in $(seq 300); do
    [ "$(answered)" -eq "$before" ] || break
    sleep 0.2
done
before=$(answered)
podman kill --signal TERM $name >/dev/null
code=$(podman wait $name)
[ "$code" = 0 ] || fail "SIGTERM: it ended with $code"
after=$(answered)
[ "$after" -gt "$before" ] || fail "no request was in it"
! podman logs $name 2>&1 | grep -E '"error": "(cancelled|detector-failed|worker-lost)"' ||
    fail "a request was lost"
echo "SIGTERM: drained, ended with 0"
echo "image-test: passed"
