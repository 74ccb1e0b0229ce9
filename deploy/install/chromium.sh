#!/usr/bin/env bash
# chromium.sh: make sure that Debian's chromium is there; only the browser tests need it.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
. "$here/common.sh"

if command -v chromium >/dev/null; then
    exit 0
fi
apt_install chromium fonts-dejavu-core || stop "the tests need chromium. Install it: sudo apt install chromium fonts-dejavu-core"
