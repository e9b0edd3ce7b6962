#!/usr/bin/env bash
# Takes the README's screenshots anew: runs the first day of a rig in a browser, and keeps three of its pictures.
# Needs chromium and chromium-driver. All pictures stay in target/pages/.
set -euo pipefail
cd "$(dirname "$0")/.."

cargo test --locked --test api browser::story -- --nocapture
pictures=$(realpath -m "${CARGO_TARGET_DIR:-target}")/pages
for name in run model predict; do
  cp "$pictures/$name-top.png" "docs/page-$name.png"
done
