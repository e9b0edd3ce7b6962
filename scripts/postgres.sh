#!/usr/bin/env bash
# Makes and starts a PostgreSQL of its own in a new directory, on a free port of loopback, and prints its URL; the second
# line is the directory. `scripts/postgres.sh restart DIRECTORY` ends it as a crash would and starts it again,
# `scripts/postgres.sh stop DIRECTORY` ends it and removes the directory. Prints nothing and fails where there is no
# PostgreSQL (Debian: apt-get install postgresql).
set -euo pipefail

bin=$(ls -d /usr/lib/postgresql/*/bin 2>/dev/null | sort -V | tail -1)
[ -n "$bin" ] || bin=$(dirname "$(command -v pg_ctl)")

# PostgreSQL refuses to run as root.
as_postgres() {
  if [ "$(id -u)" = 0 ]; then setpriv --reuid=postgres --regid=postgres --clear-groups -- "$@"; else "$@"; fi
}

if [ "${1:-}" = restart ]; then
  cd "$2"
  as_postgres "$bin/pg_ctl" -D "$2/data" -m immediate stop >/dev/null
  as_postgres "$bin/pg_ctl" -D "$2/data" -l "$2/log" -w -o "$(cat "$2/options")" start >/dev/null
  exit
fi

if [ "${1:-}" = stop ]; then
  as_postgres "$bin/pg_ctl" -D "$2/data" -m immediate stop >/dev/null
  rm -rf "$2"
  exit
fi

directory=$(mktemp -d)
if [ "$(id -u)" = 0 ]; then chown postgres "$directory"; fi
cd "$directory"
as_postgres "$bin/initdb" -D "$directory/data" -U rigcast -A trust --no-sync >/dev/null
port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
options="-c listen_addresses=127.0.0.1 -c port=$port -c unix_socket_directories= -c max_connections=300"
echo "$options" >"$directory/options"
as_postgres "$bin/pg_ctl" -D "$directory/data" -l "$directory/log" -w -o "$options" start >/dev/null
echo "postgres://rigcast@127.0.0.1:$port/postgres"
echo "$directory"
