#!/usr/bin/env bash
# Whether the wheel works where there is no checkout: built, installed into an environment of its own, the demo run.
set -euo pipefail
. "$(dirname "$0")/setup.sh"

away=$(mktemp -d)
trap 'rm -rf "$away"' EXIT
.venv/bin/uv build -q --wheel --out-dir "$away"
"$python" -m venv "$away/venv"
.venv/bin/uv pip install -q -p "$away/venv" --require-hashes -r requirements.lock
.venv/bin/uv pip install -q -p "$away/venv" --no-deps "$away"/dtwin_metrology-*.whl
cd "$away"
export DTWIN_HOME="$away/home"
venv/bin/python -c 'import dtwin; print(dtwin.open_home())'
venv/bin/dtwin demo --quick
