#!/usr/bin/env bash
# faketime.sh: make sure that libfaketime is there; only the tests need it (clocks that are set while a farm runs).
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
. "$here/common.sh"

there() {
    compgen -G '/usr/lib/*/faketime/libfaketimeMT.so.1' >/dev/null
}

if there; then
    exit 0
fi
apt_install faketime && there || stop "the tests need libfaketime. Install it: sudo apt install faketime"
