#!/usr/bin/env bash
# libllvm.sh VENV: make sure that the renderer finds a libLLVM that it can use on a CPU (16 or newer).
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
. "$here/common.sh"

python=$1/bin/python

usable() {
    "$python" -c '
import sys
from kiln_schemas.errors import MachineLacks
from kiln_workers.render.backend import find_llvm
try:
    find_llvm()
except MachineLacks as lack:
    print(lack, file=sys.stderr)
    sys.exit(1)
' "$@"
}

if lack=$(usable 2>&1); then
    exit 0
fi
sentence "$lack"
for version in 19 20 18 17 16; do
    if apt_install "libllvm$version" && usable; then
        exit 0
    fi
    as_root true || break
done
stop "libLLVM could not be installed here. Install it yourself, for instance: sudo apt install libllvm19"
