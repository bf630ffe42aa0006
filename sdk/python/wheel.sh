#!/bin/sh
# Builds the wheel with the programs inside.
# Usage: sdk/python/wheel.sh [DIRECTORY]   (where the wheel goes; target/wheels by default)
# CZ_PYTHON is the Python whose pip builds it, CZ_PROGRAMS the directory of programs that are built already.
set -eu
cd "$(dirname "$0")/../.."
out=${1:-target/wheels}
if [ -z "${CZ_PROGRAMS:-}" ]; then
    cargo build --release --workspace --bins
    cargo build --release -p control-zones-env -p control-zones-c
    CZ_PROGRAMS=${CARGO_TARGET_DIR:-target}/release
fi
# It is built elsewhere.
CZ_PROGRAMS=$(realpath "$CZ_PROGRAMS")
export CZ_PROGRAMS
rm -f "$out"/control_zones-*.whl
"${CZ_PYTHON:-python3}" -m pip --disable-pip-version-check wheel --quiet --no-deps --wheel-dir "$out" ./sdk/python
ls -l "$out"/control_zones-*-manylinux_*.whl
