#!/usr/bin/env bash
# What a newcomer sees: `make demo` and `make test` of what is committed here, on a Debian with
# nothing but Python, make, git and certificates. Prints a row of CONTRIBUTING's table.
#
# usage: scripts/newcomer.sh SUITE [PYTHON]    as root, with debootstrap
#
# SUITE: bookworm: Python 3.11; trixie: 3.13; testing: 3.14. PYTHON: another's folder on this machine,
# used in the place of the suite's own, e.g. ~/.pyenv/versions/3.12.1.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/bare_debian.sh
suite=${1:?usage: $0 SUITE [PYTHON]}
other=${2:-}
if [ "$(id -u)" != 0 ] || ! command -v debootstrap >/dev/null; then
    echo "newcomer: needs root, and Debian with debootstrap" >&2
    exit 1
fi

work=$(mktemp -d)
root=$work/root
mounted=()
finish() {
    for path in "${mounted[@]}"; do umount "$path"; done
    rm -rf --one-file-system "$work"
}
trap finish EXIT
share() { # PATH of this machine, read-only where it is in the other
    if [ -d "$1" ]; then mkdir -p "$root$1"; else mkdir -p "$root${1%/*}" && touch "$root$1"; fi
    mount --bind "$1" "$root$1"
    mounted=("$root$1" "${mounted[@]}")
    case $1 in /proc | /dev*) ;; *) mount -o remount,bind,ro "$root$1" ;; esac
}

bare_debian "$root" python3,python3-venv,make,git,ca-certificates "$suite"
pip_settings "$root/etc/pip.conf"
for path in /proc /dev /dev/shm /dev/pts $other $(pip_paths "$root/etc/pip.conf"); do share "$path"; done
git clone --quiet . "$root/edgegrasp"

inside() {
    chroot "$root" env -i HOME=/root LANG=C.UTF-8 PATH="${other:+$other/bin:}/usr/sbin:/usr/bin:/sbin:/bin" \
        bash -c "cd /edgegrasp && $1"
}
minutes() { # COMMAND: runs it and prints the minutes, or that it failed
    local begun=$SECONDS
    if inside "$1" >"$work/log" 2>&1; then
        printf '%d min %02d' $(((SECONDS - begun) / 60)) $(((SECONDS - begun) % 60))
    else
        tail -n 30 "$work/log" >&2
        echo "failed after $((SECONDS - begun)) s"
    fi
}
version=$(inside 'python3 -c "import platform; print(platform.python_version())"')
demo=$(minutes 'make demo')
engine=$(sed -n 's/^engine: \([a-z]*\).*/\1/p' "$work/log")
tests=$(minutes 'make test')
summary=$(grep -o -E '[0-9]+ passed.*' "$work/log" | tail -n 1 | sed 's/ in .*//')
size=$(du -sm "$root/edgegrasp/.venv" | cut -f 1)
echo "| $suite | $version | $engine | $demo | $tests: ${summary:-no summary} | $size MB |"
