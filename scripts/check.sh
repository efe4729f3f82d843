#!/usr/bin/env bash
# All checks that a change must pass, in a separate environment (.venv, made if missing):
#   bash scripts/check.sh [pytest arguments]   as CI does: the short tests, compiled with fast options
#   bash scripts/check.sh --long               with the long tests
#   bash scripts/check.sh --shipped            tests of impact, simulation, orbits, continuation, design and maps, compiled
#                                              as users compile them, and a comparison of a million impacts of each kind
#                                              between options of the compiler
#   bash scripts/check.sh --newest             the short tests with the newest Python and the newest packages, in .venv-newest
set -euo pipefail
cd "$(dirname "$0")/.."
python=python3 environment=.venv
if [[ "${1-}" == --newest ]]; then
  shift
  environment=.venv-newest
  for found in python3.13 python3.12 python3; do
    # A command may exist without a Python: pyenv has a shim for all versions, installed or not.
    if "$found" --version >/dev/null 2>&1; then python="$found" && break; fi
  done
  export VIJAX_NEWEST=1
  versions=(--upgrade --upgrade-strategy eager)
  strict=(-W error::DeprecationWarning -W error::FutureWarning
    # Lanes in a GPU's registers need float64, which only this backend of Pallas supports (docs/scale.md).
    -W "ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
else
  versions=(--constraint "$("$python" -m scripts.constraints)")
  strict=()
fi
"$python" -m venv "$environment"
export PATH="$PWD/$environment/bin:$PATH"
python --version
# Python compiles a module at its first import; pip would compile ten thousand, and most are never imported.
export PYTHONDONTWRITEBYTECODE=
python -m pip install --quiet --no-compile "${versions[@]}" --editable '.[test]'
if [ "${1:-}" = --shipped ]; then
  shift
  VIJAX_TEST_FLAGS=shipped pytest -n 2 --dist loadfile --no-loadscope-reorder "$@" tests/{impact,simulation,orbits,continuation,design,maps}
  exec python benchmarks/compiler_options.py
fi
ruff check .
ruff format --check .
lint-imports
# mypy runs during the tests, which leave a core idle at their start and end; its report is printed last.
mypy >"$environment/types.txt" 2>&1 &
types=$!
failed=0
# A file runs in one process, so the programs that its tests share are compiled once; tests/conftest.py orders files.
pytest -n 2 --dist loadfile --no-loadscope-reorder ${strict[@]+"${strict[@]}"} "$@" || failed=$?
wait "$types" || failed=$?
cat "$environment/types.txt"
# Printed last, as a line among the reasons of skipped tests is overlooked.
if ! command -v chromium chromium-browser google-chrome >/dev/null; then
  echo "SKIPPED: pages were not tested in a browser (tests/explorer/test_browser.py), as no Chromium is installed; apt-get install chromium brings it on Debian"
fi
exit "$failed"
