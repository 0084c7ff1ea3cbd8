#!/usr/bin/env bash
# README's second command: set up, then run every check.
set -euo pipefail
# A third of what the libraries hold is ever imported: it is compiled then, and kept.
unset PYTHONDONTWRITEBYTECODE
compile=""
. "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

.venv/bin/ruff check .
.venv/bin/ruff format --check --quiet . || { echo "run: .venv/bin/ruff format ."; exit 1; }
# Types, contracts and documentation take little from the tests, and say what they found meanwhile. Less than this
# would leave a minute of them to one processor when the tests have ended.
said=$(mktemp)
trap 'rm -f "$said"' EXIT
quiet() { nice -n 10 "$@"; }
(
    export NO_MKDOCS_2_WARNING=1
    { quiet .venv/bin/mypy && quiet .venv/bin/lint-imports && quiet .venv/bin/mkdocs build --strict --site-dir .dtwin/site; } >"$said" 2>&1 || failed=1
    cat "$said"
    exit "${failed:-0}"
) &
beside=$!
# Collects all, so that what the tests import is compiled and their asserts are rewritten, and runs a test that trains, by which numba
# compiles (20 s): every worker would do both for itself. Whatever fails here fails below, too.
[ $# -gt 0 ] || .venv/bin/python -m pytest -q -m "not long" -k test_what_was_trained_on_is_not_new >/dev/null || true
# Of .ci/run: what only the tests need.
[ -z "${installing:-}" ] || wait "$installing"
tests=0
# Arrays that a fit frees stay in the process: half as many page faults, a tenth less time.
export MALLOC_MMAP_THRESHOLD_=33554432 MALLOC_TRIM_THRESHOLD_=536870912
OMP_NUM_THREADS=1 .venv/bin/python -m pytest -q -n 3 --no-loadscope-reorder -m "not long" "$@" || tests=$?
wait "$beside" || { cat "$said"; echo "types, contracts or documentation: see above"; exit 1; }
exit "$tests"
