#!/usr/bin/env bash
# Prints the path of axe-core, which checks pages for what keeps people out; nothing where npm cannot have it.
set -euo pipefail
cd "$(dirname "$0")/.."

version=4.10.3
folder=$(realpath -m "${CARGO_TARGET_DIR:-target}")/axe-$version
file=$folder/node_modules/axe-core/axe.min.js
if [ ! -e "$file" ]; then
  mkdir -p "$folder"
  npm install --silent --no-audit --no-fund --prefix "$folder" "axe-core@$version" >&2 || exit 0
fi
[ ! -e "$file" ] || echo "$file"
