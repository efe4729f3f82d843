#!/usr/bin/env bash
# What the wheel does alone, installed in an empty environment, outside of the repository: bash scripts/wheel.sh
set -euo pipefail
cd "$(dirname "$0")/.."
unset PYTHONPATH
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
python3 -m venv "$place/empty"
export PATH="$place/empty/bin:$PATH"
python -m pip wheel --quiet --no-deps --wheel-dir "$place" .
python -m pip install --quiet --constraint constraints.txt "$place"/vijax-*.whl
cd "$place"
vijax --version
vijax sweep --d 0.05:0.3:32 --kappa 3:400:32:log --plot map.png
test -s map.png
