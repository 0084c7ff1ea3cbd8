#!/usr/bin/env bash
# README's first command: set up, then run the main job.
set -euo pipefail
. "$(dirname "$0")/setup.sh"
exec .venv/bin/dtwin demo "$@"
