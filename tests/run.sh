#!/usr/bin/env bash
# README's second command: set up, then run every check.
set -euo pipefail
. "$(dirname "$0")/setup.sh"

.venv/bin/ruff check .
.venv/bin/ruff format --check --quiet . || { echo "run: .venv/bin/ruff format ."; exit 1; }
.venv/bin/mypy
.venv/bin/lint-imports
NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict --site-dir .dtwin/site
OMP_NUM_THREADS=1 .venv/bin/python -m pytest -q -n 3 --no-loadscope-reorder "$@"
