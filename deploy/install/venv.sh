#!/usr/bin/env bash
# venv.sh DIR EXTRAS [--copy]: a virtual environment in DIR with lightkiln[EXTRAS] at the pinned versions, in editable
# form or, with --copy, without need of this folder afterwards (the images).
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
root=$(cd "$here/../.." && pwd)
. "$here/common.sh"

venv=$1
extras=$2
form=(-e)
if [ "${3:-}" = --copy ]; then
    form=()
fi

# The oldest supported Python first: it is what everything is tested with.
find_python() {
    local candidate
    for candidate in ${PYTHON:-} python3.11 python3.12 python3.13 python3; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    return 1
}

if ! [ -x "$venv/bin/python" ] || ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
    python=$(find_python) || stop "Python 3.11 or newer is needed and was not found. Install it, or name it: make PYTHON=/path/to/python3.11."
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        package=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
        apt_install "$package" || stop "$python has no module venv. Install the package $package: sudo apt install $package"
    fi
    "$python" -m venv --clear "$venv"
fi
sentence "installing lightkiln[$extras] into $venv (some minutes the first time)"
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check -c "$root/constraints.txt" "${form[@]}" "$root[$extras]"
