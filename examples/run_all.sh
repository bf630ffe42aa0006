#!/bin/sh
# Builds every example controller and runs it on zone 2 of the default scenario, and every example world, as CI does.
# Usage: examples/run_all.sh [PROFILE]   (release by default)
set -eu
cd "$(dirname "$0")/.."
profile=${1:-release}
flag=""
[ "$profile" = release ] && flag=--release
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

cargo build $flag --bins
cargo build $flag -p control-zones-c
cargo build $flag -p control-zones-plugin --example mpc
cargo build $flag --example world
cargo build $flag -p control-zones-env
cz=target/$profile/cz

python=${CZ_PYTHON:-}
if [ -z "$python" ]; then
    python3 -m venv "$work/venv"
    "$work/venv/bin/pip" install -q ./sdk/python numpy quadprog
    python=$work/venv/bin/python
fi

"$cz" sdk install --prefix "$work/sdk" >/dev/null
pc() { PKG_CONFIG_PATH="$work/sdk/lib/pkgconfig" pkg-config "$@" control-zones; }
cc -std=c99 -Wall -Wextra -Werror examples/c/headway.c -o "$work/headway" $(pc --cflags --libs) -lm
c++ -std=c++17 -Wall -Wextra -Werror examples/cpp/idm.cpp -o "$work/idm" $(pc --cflags --libs)

for controller in "$work/headway" "$work/idm" "target/$profile/examples/mpc" "$python examples/python/ocbf.py"; do
    echo "== $controller"
    "$cz" plugin check -- $controller
    "$cz" run --controller merge-2="$controller"
done

export CZ_ENV_LIBRARY="$PWD/target/$profile/libcontrol_zones_env.so"
for world in "target/$profile/examples/world" "$python examples/python/world.py"; do
    echo "== $world"
    "$cz" world check -- $world
    "$cz" run --world "$world"
done
