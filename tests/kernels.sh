#!/usr/bin/env bash
# The tests of numbers and pages under other kernels of OpenBLAS, with the other core busy: what a
# figure shows must not depend on the processor. About ten minutes a kernel.
set -euo pipefail
. "$(dirname "$0")/setup.sh"
while :; do :; done &
busy=$!
trap 'kill "$busy"' EXIT
for kernel in ${*:-Nehalem Haswell SkylakeX}; do
    echo "== $kernel"
    OPENBLAS_CORETYPE="$kernel" OMP_NUM_THREADS=1 .venv/bin/python -m pytest -q -n 1 -m "not long" \
        tests/unit/physics tests/unit/train tests/unit/features tests/unit/report tests/unit/serve tests/campaign \
        tests/system/test_readme.py tests/system/test_tutorials.py tests/system/test_analogue_page.py \
        tests/system/test_exam_short.py
done
