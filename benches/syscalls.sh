#!/usr/bin/env bash
# System calls of each process of a run, per thousand steps, once the run has settled.
#
#   cargo build --release && benches/syscalls.sh [OPTIONS OF cz run]
#
# Needs perf, and the right to trace system calls (root, as a rule).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

cz=${CZ:-target/release/cz}
window_s=3
directory=$(mktemp -d)
supervisor=
trap '[[ -z $supervisor ]] || kill "$supervisor" 2>/dev/null || true; rm -rf "$directory"' EXIT

# Two zones under steady demand, for long enough: about ten seconds.
rates='[{until_s=400000.0,vehicles_per_hour=300.0}]'
"$cz" run varying-demand --set end.time_s=400000 --pin auto --json "$directory/summary.json" \
    --set "roads.main1.demand.rates=$rates" --set "roads.merge1.demand.rates=$rates" \
    --set "roads.merge2.demand.rates=$rates" "$@" >"$directory/table" &
supervisor=$!
sleep 2

names=() tracers=()
for process in $(pgrep -P "$supervisor"); do
    name=$(tr '\0' ' ' <"/proc/$process/cmdline" | awk '{ print $2 }')
    name+=$(tr '\0' ' ' <"/proc/$process/cmdline" | grep -o -- '--index [0-9]*' | sed 's/--index//' || true)
    perf record -q -e raw_syscalls:sys_enter -c 1 -o "$directory/$process.perf" -p "$process" \
        -- sleep "$window_s" >/dev/null 2>&1 &
    names+=("$process:$name") tracers+=($!)
done
wait "${tracers[@]}"
wait "$supervisor"
supervisor=

python3 - "$directory" "$window_s" "${names[@]}" <<'PYTHON'
import collections, json, re, subprocess, sys

directory, window_s, names = sys.argv[1], float(sys.argv[2]), sys.argv[3:]
summary = json.load(open(f"{directory}/summary.json"))
steps = summary["steps"] / summary["wall_s"] * window_s
# Of x86-64, and only what is to be expected; others are shown by number.
known = {72: "fcntl", 54: "setsockopt", 332: "statx", 0: "read", 1: "write", 7: "poll", 24: "sched_yield", 35: "nanosleep", 44: "sendto", 45: "recvfrom",
         202: "futex", 230: "clock_nanosleep", 228: "clock_gettime", 271: "ppoll", 270: "pselect6",
         23: "select", 257: "openat", 3: "close", 12: "brk", 9: "mmap", 25: "mremap", 281: "epoll_pwait"}
print(f"{steps:.0f} steps in {window_s:.0f} s")
for entry in names:
    process, name = entry.split(":", 1)
    script = ["perf", "script", "-i", f"{directory}/{process}.perf", "-F", "trace"]
    text = subprocess.run(script, capture_output=True, text=True).stdout
    calls = collections.Counter(int(n) for n in re.findall(r"NR (\d+)", text))
    per = ", ".join(f"{known.get(n, n)} {1000 * c / steps:.2f}" for n, c in calls.most_common())
    print(f"{name.strip():12} {1000 * sum(calls.values()) / steps:8.2f} per 1000 steps: {per or 'none'}")
PYTHON
