#!/usr/bin/env bash
# Installs other programs' readers of measurement files for the tests that use them:
#
#   RIGCAST_READERS=$(scripts/readers.sh) cargo test
#
# Prints the Python that has them, or nothing where they cannot be installed; the tests then skip.
set -euo pipefail
cd "$(dirname "$0")/.."

wanted=$(sha256sum scripts/readers-requirements.txt | cut -c1-16)
tools=$(realpath -m "${CARGO_TARGET_DIR:-target}")/readers-$wanted
if [ ! -e "$tools/installed" ]; then
  rm -rf "$tools"
  if ! { python3 -m venv "$tools" && "$tools/bin/pip" install --quiet --disable-pip-version-check \
         --requirement scripts/readers-requirements.txt && touch "$tools/installed"; } >&2; then
    rm -rf "$tools"
    echo "readers: cannot be installed here" >&2
    exit 0
  fi
fi
echo "$tools/bin/python"
