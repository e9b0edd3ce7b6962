#!/usr/bin/env bash
# Checks the running program against openapi.yaml: schemathesis sends requests that the contract allows and
# requests that it forbids, with all checks on.
#
#   scripts/contract.sh CASES        # about so many; settings in scripts/contract.toml
#
# Prints that it skips, and succeeds, where Python or its packages are missing. RIGCAST names the program.
set -euo pipefail
cd "$(dirname "$0")/.."

cases=${1:-300}
root=$PWD
target=$(realpath -m "${CARGO_TARGET_DIR:-target}")
program=${RIGCAST:-$target/debug/rigcast}
work=$(mktemp -d)
server=
stop() {
  if [ -n "$server" ]; then kill "$server" 2>/dev/null || true; wait "$server" 2>/dev/null || true; fi
  rm -rf "$work"
}
trap stop EXIT

tools=$(scripts/python_env.sh contract 2>"$work/venv.log")
if [ -z "$tools" ]; then
  echo "contract: skipped, schemathesis cannot be installed here: $(tail -1 "$work/venv.log")"
  exit 0
fi
st=$tools/bin/st

secret=$("$program" token create --role admin --name contract --data-dir "$work/data" 2>/dev/null)
# The program starts beside this: its log has to be there before it is read.
: >"$work/log"
"$program" serve --listen 127.0.0.1:0 --data-dir "$work/data" --log warn,rigcast=info >"$work/out.log" 2>"$work/log" &
server=$!
base=
for _ in $(seq 200); do
  base=$(sed -n 's/.*rigcast listens on \(http:[^" ]*\).*/\1/p' "$work/log" | head -1)
  [ -n "$base" ] && break
  sleep 0.05
done
[ -n "$base" ] || { cat "$work/log"; echo "contract: the program did not start"; exit 1; }

export RIGCAST_TOKEN=$secret
python3 scripts/contract_rig.py "$base" "$work/always" "$work/there"
status=0
total=0
# Once with a rig that has runs and a model; once with a rig that does not exist.
for void in no yes; do
  cat scripts/contract.toml "$([ $void = yes ] && echo /dev/null || echo "$work/there")" "$work/always" >"$work/contract.toml"
  # Each operation has some fixed cases besides the random ones.
  each=$((cases / 2 / 38 + 1))
  # It leaves a folder in its working directory.
  (cd "$work" && "$st" --config-file contract.toml run "$root/openapi.yaml" --url "$base" --header "Authorization: Bearer $secret" \
    --max-examples "$each" --seed "${SEED:-1}" --no-color) >"$work/report.$void" 2>&1 || status=1
  awk '/= (FAILURES|ERRORS) =/ { on = 1 } on' "$work/report.$void" | head -400
  ran=$(sed -n 's/.*[^0-9]\([0-9][0-9,]*\) generated.*/\1/p' "$work/report.$void" | tr -d , | head -1)
  total=$((total + ${ran:-0}))
done
kill -0 "$server" || { echo "contract: the program is gone"; tail -20 "$work/log"; status=1; }
if grep ' ERROR ' "$work/log" | head -5 | grep .; then status=1; fi
echo "contract: $total cases, $([ $status = 0 ] && echo 0 failures || echo failures above)"
[ "$total" -ge "$cases" ] || { echo "contract: fewer than the $cases cases asked for"; status=1; }
exit $status
