#!/usr/bin/env bash
# README's second command: set up, then run every check.
set -euo pipefail
. "$(dirname "$0")/setup.sh"

.venv/bin/ruff check .
.venv/bin/ruff format --check --quiet . || { echo "run: .venv/bin/ruff format ."; exit 1; }
# Types on one core; contracts and documentation, whose output follows, on the other.
said=$(mktemp)
trap 'rm -f "$said"' EXIT
(.venv/bin/lint-imports && NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict --site-dir .dtwin/site) >"$said" 2>&1 &
beside=$!
.venv/bin/mypy
wait "$beside" || { cat "$said"; exit 1; }
cat "$said"
OMP_NUM_THREADS=1 .venv/bin/python -m pytest -q -n 3 --no-loadscope-reorder -m "not long" "$@"
