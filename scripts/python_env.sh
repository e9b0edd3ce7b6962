#!/usr/bin/env bash
# A Python environment with the packages of scripts/NAME-requirements.txt, one per set of package versions:
#
#   scripts/python_env.sh NAME
#
# Prints its folder, or nothing where Python or the packages cannot be had: whoever asks then skips.
set -euo pipefail
cd "$(dirname "$0")/.."

requirements=scripts/$1-requirements.txt
wanted=$(sha256sum "$requirements" | cut -c1-16)
folder=$(realpath -m "${CARGO_TARGET_DIR:-target}")/$1-$wanted
if [ ! -e "$folder/installed" ]; then
  rm -rf "$folder"
  if ! { python3 -m venv "$folder" && "$folder/bin/pip" install --quiet --disable-pip-version-check \
         --requirement "$requirements" && touch "$folder/installed"; } >&2; then
    rm -rf "$folder"
    exit 0
  fi
fi
echo "$folder"
