# Functions for scripts that try things on a bare Debian: where it and packages for it come from.
# shellcheck shell=bash

# bare_debian FOLDER PACKAGES [SUITE]: Debian from the mirror that apt-get uses here, this machine's
# own release unless another is named, for $architecture where that is set.
bare_debian() {
    local mirror suite
    read -r mirror suite < <(
        apt-get indextargets --format '$(REPO_URI) $(CODENAME)' 'Created-By: Packages' | head -n 1
    )
    debootstrap ${architecture:+--arch="$architecture"} --variant=minbase --include="$2" "${3:-$suite}" "$1" "$mirror" >"$1.log" ||
        { cat "$1.log" && return 1; }
}

# pip_settings FILE: what pip's settings are here, as one file.
pip_settings() {
    "${python:-python3}" - >"$1" <<'CODE'
import ast, re, subprocess, sys
found = {}
listed = subprocess.run([sys.executable, "-m", "pip", "config", "list"], capture_output=True)
for key, value in re.findall(r"^(?::env:|\w+)\.([\w-]+)=(.*)$", listed.stdout.decode(), re.M):
    found[key] = ast.literal_eval(value).replace("\n", "\n    ")
print("[global]", *(f"{key} = {value}" for key, value in found.items()), sep="\n")
CODE
}

# pip_paths FILE: the files and folders that such settings name; an index's packages lie beside it.
pip_paths() {
    local path
    for path in $(grep -o -E '(^|[ =]|file://)/[^ ]+' "$1" | sed -E 's,^[^/]*(//)?,,; s,/simple$,,'); do
        [ ! -e "$path" ] || echo "$path"
    done | sort -u
}
