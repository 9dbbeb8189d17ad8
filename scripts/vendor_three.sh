#!/bin/bash
# Fetches the parts of three.js that the playground uses; needs npm. usage: vendor_three.sh VERSION
#
# The files are the package's own, but for what they import: the file beside them, for `three`.
set -euo pipefail
vendor=$(cd "$(dirname "$0")/.." && pwd)/service/edgegrasp_service/playground/vendor
unpacked=$(mktemp -d)
trap 'rm -rf "$unpacked"' EXIT
cd "$unpacked"
npm pack --silent "three@$1" >/dev/null
tar xzf three-*.tgz
cd package
cp LICENSE build/three.module.min.js build/three.core.min.js \
    examples/jsm/controls/{Orbit,Transform}Controls.js examples/jsm/loaders/{PLY,PCD}Loader.js "$vendor"
sed -i "s|from 'three'|from './three.module.min.js'|" "$vendor"/*{Controls,Loader}.js
echo "$1" >"$vendor/VERSION"
