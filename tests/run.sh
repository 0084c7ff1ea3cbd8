#!/usr/bin/env bash
# Set up an environment of its own and run every check; the README's second command.
set -euo pipefail
cd "$(dirname "$0")/.."

python="${PYTHON:-python3}"
"$python" -m venv .venv
.venv/bin/python -m pip install -q uv
.venv/bin/uv pip install -q -p .venv --require-hashes -r requirements.lock
.venv/bin/uv pip install -q -p .venv --no-deps -e .

.venv/bin/ruff check .
.venv/bin/ruff format --check --quiet . || { echo "run: .venv/bin/ruff format ."; exit 1; }
.venv/bin/mypy
.venv/bin/lint-imports
OMP_NUM_THREADS=1 .venv/bin/python -m pytest -q "$@"
