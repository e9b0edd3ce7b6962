#!/usr/bin/env bash
# Takes the README's screenshots anew: runs the first day of a rig and a comparison of three axes in a browser, and keeps
# three of their pictures.
# Needs chromium and chromium-driver. All pictures stay in target/pages/.
set -euo pipefail
cd "$(dirname "$0")/.."

cargo test --locked --test api -- browser::story browser::comparison --nocapture
pictures=$(realpath -m "${CARGO_TARGET_DIR:-target}")/pages
cp "$pictures/run-top.png" docs/page-run.png
cp "$pictures/model-top.png" docs/page-model.png
cp "$pictures/predict-directions-top.png" docs/page-predict.png
