#!/bin/sh
# The server, with the loops that were compiled for processors of this kind; of any other kind they
# are compiled as it starts. Numba reads them only from where it could write new ones.
case "$(uname -m) $(grep -m 1 '^flags' /proc/cpuinfo)" in
    aarch64*) kinds=generic ;;
    *avx512vl*) kinds="x86-64-v4 x86-64-v3" ;;
    *avx2*) kinds=x86-64-v3 ;;
esac
export NUMBA_CACHE_DIR=/tmp/loops
for kind in $kinds; do
    if cp -r "/venv/loops/$kind" $NUMBA_CACHE_DIR 2>/dev/null; then
        export NUMBA_CPU_NAME="$kind" NUMBA_CPU_FEATURES=
        break
    fi
done
exec edgegrasp serve "$@"
