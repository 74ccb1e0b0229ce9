#!/usr/bin/env bash
# node.sh: make sure that node and npm are there; only the tests need them (independent readers of our files).
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
. "$here/common.sh"

if command -v node >/dev/null && command -v npm >/dev/null; then
    exit 0
fi
apt_install nodejs npm || stop "the tests need node (18 or newer) and npm. Install them: sudo apt install nodejs npm"
