# Shared by the install scripts: say a sentence and stop; install Debian packages where this user may.

sentence() {
    echo "lightkiln: $*" >&2
}

stop() {
    sentence "$*"
    exit 1
}

# As root, or through sudo where it asks for no password.
as_root() {
    if [ "$(id -u)" -eq 0 ]; then
        "$@"
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        sudo -n "$@"
    else
        return 1
    fi
}

# apt_install PACKAGE...: true only where all are installed afterwards.
apt_install() {
    command -v apt-get >/dev/null || return 1
    as_root true || return 1
    sentence "installing $* with apt-get"
    as_root apt-get update -qq || return 1
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >&2
}
