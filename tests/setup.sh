# Sourced: an environment of its own in .venv, from the hashed lock. Repeating it costs nothing.
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python="${PYTHON:-python3}"
# A network may have an authority of its own, which the system's store of certificates knows.
export UV_SYSTEM_CERTS="${UV_SYSTEM_CERTS:-true}"
stamp=".venv/.locked-$(cat requirements.lock pyproject.toml | cksum | tr -d ' ')"
if [ ! -e "$stamp" ]; then
    "$python" -c 'import sys; v = sys.version_info[:2]; sys.exit(f"dtwin needs Python 3.11 or 3.12, this is {v[0]}.{v[1]}; set PYTHON=") if v not in ((3, 11), (3, 12)) else None'
    "$python" -m venv .venv
    .venv/bin/python -m pip install -q uv
    # tests/run.sh says compile="": it compiles what it imports itself.
    .venv/bin/uv pip install -q ${compile---compile-bytecode} -p .venv --require-hashes -r requirements.lock
    .venv/bin/uv pip install -q -p .venv --no-deps -e .
    touch "$stamp"
fi
# Where Python may not write bytecode, every command of a test would compile dtwin again.
.venv/bin/python -m compileall -q dtwin flows studies
