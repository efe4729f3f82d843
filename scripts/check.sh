#!/usr/bin/env bash
# Everything a change must pass, in an environment of its own (.venv, made at need):
#   bash scripts/check.sh [pytest arguments]   as CI does: what is quick and compiles quickly
#   bash scripts/check.sh --long               with the long tests
#   bash scripts/check.sh --shipped            engine, batch, orbits, design and planes compiled as users compile them, and
#                                              a million impacts of each kind compared between options of the compiler
set -euo pipefail
cd "$(dirname "$0")/.."
python3 -m venv .venv
export PATH="$PWD/.venv/bin:$PATH"
# Python compiles a module when it first imports it; pip would compile ten thousand, of which most are never imported.
export PYTHONDONTWRITEBYTECODE=
python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[test]'
if [ "${1:-}" = --shipped ]; then
  shift
  VIJAX_TEST_FLAGS=shipped pytest -n 2 --dist loadfile --no-loadscope-reorder "$@" tests/{engine,batch,orbits,design,planes}
  exec python benchmarks/compiler_options.py
fi
ruff check .
ruff format --check .
lint-imports
# Types are checked beside the tests, which leave a core idle as they begin and end; what mypy says comes last.
mypy >.venv/types.txt 2>&1 &
types=$!
failed=0
# A file to a process: the programs that its tests share are compiled once. Files run in the order of tests/conftest.py.
pytest -n 2 --dist loadfile --no-loadscope-reorder "$@" || failed=$?
wait "$types" || failed=$?
cat .venv/types.txt
# Said last, as a line among the reasons of skipped tests is overlooked.
if ! command -v chromium chromium-browser google-chrome >/dev/null; then
  echo "SKIPPED: pages were not looked at in a browser (tests/explorer/test_browser.py), as no Chromium is installed; apt-get install chromium brings it on Debian"
fi
exit "$failed"
