#!/usr/bin/env bash
# Make .venv with pinned versions and install this checkout into it. Safe to call again: does nothing if nothing changed.
# PYTHON chooses the interpreter (3.10 to 3.12), VENV the folder, EXTRAS the optional dependencies (default dev).
set -euo pipefail
cd "$(dirname "$0")/.."
venv="${VENV:-.venv}"
python="${PYTHON:-}"
if [ -z "$python" ]; then
    for candidate in python3.11 python3.12 python3.10 python3; do
        if command -v "$candidate" >/dev/null 2>&1 \
            && "$candidate" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 13))' 2>/dev/null; then
            python="$candidate"; break
        fi
    done
fi
[ -n "$python" ] || { echo "setup_env: no Python 3.10-3.12 found; install one or set PYTHON=/path/to/python" >&2; exit 2; }
stamp="$(cat constraints.txt pyproject.toml setup.py | sha256sum | cut -d' ' -f1)"
if [ "$(cat "$venv/.installed" 2>/dev/null || true)" = "$stamp" ]; then
    exit 0
fi
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
install() { "$venv/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }
# torch comes first and pinned: anything else asking for it would pull gigabytes of CUDA packages
install --constraint constraints.txt torch setuptools wheel
install --constraint constraints.txt --no-build-isolation --editable ".[${EXTRAS:-dev}]"
echo "$stamp" > "$venv/.installed"
echo "setup_env: $("$venv/bin/python" --version) in $venv; activate with: source $venv/bin/activate" >&2
