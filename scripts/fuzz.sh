#!/usr/bin/env bash
# Fuzzes every reader, each for so many seconds, with cargo-fuzz (`cargo install cargo-fuzz --locked`):
#
#   scripts/fuzz.sh SECONDS [TARGET...]
#
# New inputs are kept in fuzz/corpus, inputs that fail in fuzz/artifacts.
set -euo pipefail
cd "$(dirname "$0")/../fuzz"

seconds=${1:-60}
shift || true
targets=("$@")
[ $# -gt 0 ] || mapfile -t targets < <(sed -n 's|^path = "fuzz_targets/\(.*\)\.rs"|\1|p' Cargo.toml)
target_dir=${FUZZ_TARGET_DIR:-target}
command -v cargo-fuzz >/dev/null || { echo "fuzz: skipped, there is no cargo-fuzz"; exit 0; }

# The code is safe Rust but for one place: without a sanitizer it runs on the pinned toolchain, twice as fast.
cargo fuzz build --sanitizer none --target-dir "$target_dir"
status=0
for target in "${targets[@]}"; do
  log=$(mktemp)
  if cargo fuzz run --sanitizer none --target-dir "$target_dir" "$target" -- -max_total_time="$seconds" \
       -timeout=5 -rss_limit_mb=512 -max_len=8192 -print_final_stats=1 >"$log" 2>&1; then
    crashes="0 crashes"
  else
    crashes=CRASHED
    status=1
    grep -a -m 20 -A 10 'panicked at\|ERROR: libFuzzer' "$log" || tail -20 "$log"
  fi
  stat() { sed -n "s/^stat::$1: *//p" "$log" | tail -1; }
  echo "fuzz $target: $(stat number_of_executed_units) inputs in $seconds s, $(stat peak_rss_mb) MiB at most, $crashes"
  rm -f "$log"
done
exit $status
