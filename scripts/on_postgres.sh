#!/usr/bin/env bash
# Runs a command, such as tests, with RIGCAST_TEST_DATABASE naming a PostgreSQL of its own. Prints that it skips, and
# succeeds, where there is none.
set -euo pipefail
cd "$(dirname "$0")/.."

started=$(scripts/postgres.sh 2>/dev/null) || { echo "skipped: no PostgreSQL can be started (apt-get install postgresql)"; exit 0; }
trap 'scripts/postgres.sh stop "$(sed -n 2p <<<"$started")"' EXIT
RIGCAST_TEST_DATABASE=$(head -1 <<<"$started") "$@"
