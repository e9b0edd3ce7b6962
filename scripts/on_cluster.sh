#!/usr/bin/env bash
# Runs a command, such as a benchmark, with a PostgreSQL and a storage of S3's protocol of its own, named by RIGCAST_DATABASE and
# RIGCAST_OBJECTS. Prints that it skips, and succeeds, where one of them cannot be had.
set -euo pipefail
cd "$(dirname "$0")/.."

tools=$(scripts/python_env.sh storage 2>/dev/null)
[ -n "$tools" ] || { echo "skipped: no storage can be installed (scripts/python_env.sh storage)"; exit 0; }
started=$(scripts/postgres.sh 2>/dev/null) || { echo "skipped: no PostgreSQL can be started (apt-get install postgresql)"; exit 0; }
server=
stop() {
  scripts/postgres.sh stop "$(sed -n 2p <<<"$started")"
  [ -z "$server" ] || kill "$server" 2>/dev/null || true
}
trap stop EXIT
port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
"$tools/bin/moto_server" -H 127.0.0.1 -p "$port" >/dev/null 2>&1 &
server=$!
export RIGCAST_S3_ENDPOINT=http://127.0.0.1:$port
for _ in $(seq 200); do
  curl -sf -X PUT "$RIGCAST_S3_ENDPOINT/lab" >/dev/null 2>&1 && break
  sleep 0.1
done
export RIGCAST_DATABASE RIGCAST_OBJECTS=s3://lab/one AWS_ACCESS_KEY_ID=engineer AWS_SECRET_ACCESS_KEY=engineer
RIGCAST_DATABASE=$(head -1 <<<"$started")
"$@"
