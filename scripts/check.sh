#!/usr/bin/env bash
# Everything a change must pass, in an environment of its own (.venv, made at need):
#   bash scripts/check.sh [pytest arguments]   as CI does: what is quick and compiles quickly
#   bash scripts/check.sh --long               with the long tests
#   bash scripts/check.sh --shipped            engine, batch, orbits, design and planes compiled as users compile them, and
#                                              a million impacts of each kind compared between options of the compiler
#   bash scripts/check.sh --newest             the first with the newest Python and the newest of everything, in .venv-newest
set -euo pipefail
cd "$(dirname "$0")/.."
python=python3 environment=.venv
if [[ "${1-}" == --newest ]]; then
  shift
  environment=.venv-newest
  for found in python3.13 python3.12 python3; do
    # A name may be there and start nothing: pyenv has a shim for each Python that it knows.
    if "$found" --version >/dev/null 2>&1; then python="$found" && break; fi
  done
  export VIJAX_NEWEST=1
  versions=(--upgrade --upgrade-strategy eager)
  strict=(-W error::DeprecationWarning -W error::FutureWarning
    # Lanes in a GPU's registers need float64, and no other way of Pallas has it (docs/scale.md).
    -W "ignore:The Pallas Triton backend is deprecated:DeprecationWarning")
else
  versions=(--constraint "$("$python" -m scripts.constraints)")
  strict=()
fi
"$python" -m venv "$environment"
export PATH="$PWD/$environment/bin:$PATH"
python --version
# Python compiles a module when it first imports it; pip would compile ten thousand, of which most are never imported.
export PYTHONDONTWRITEBYTECODE=
python -m pip install --quiet --no-compile "${versions[@]}" --editable '.[test]'
if [ "${1:-}" = --shipped ]; then
  shift
  VIJAX_TEST_FLAGS=shipped pytest -n 2 --dist loadfile --no-loadscope-reorder "$@" tests/{engine,batch,orbits,design,planes}
  exec python benchmarks/compiler_options.py
fi
ruff check .
ruff format --check .
lint-imports
# Types are checked beside the tests, which leave a core idle as they begin and end; what mypy says comes last.
mypy >"$environment/types.txt" 2>&1 &
types=$!
failed=0
# A file to a process: the programs that its tests share are compiled once. Files run in the order of tests/conftest.py.
pytest -n 2 --dist loadfile --no-loadscope-reorder ${strict[@]+"${strict[@]}"} "$@" || failed=$?
wait "$types" || failed=$?
cat "$environment/types.txt"
# Said last, as a line among the reasons of skipped tests is overlooked.
if ! command -v chromium chromium-browser google-chrome >/dev/null; then
  echo "SKIPPED: pages were not looked at in a browser (tests/explorer/test_browser.py), as no Chromium is installed; apt-get install chromium brings it on Debian"
fi
exit "$failed"
