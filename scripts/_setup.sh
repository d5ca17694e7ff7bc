# Sourced by scripts/demo and scripts/test: leaves a ready .venv, or stops with one line that says what to do.
# shellcheck shell=bash
set -euo pipefail
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
cd "$ROOT"

say() { printf 'bimfit: %s\n' "$*" >&2; }
die() { say "$*"; exit 1; }

# Install Debian or Ubuntu packages where that is allowed, else name the command.
system_packages() {
    if ! command -v apt-get >/dev/null 2>&1; then
        die "missing system libraries; install what your system calls: $*"
    elif [ "$(id -u)" = 0 ]; then
        say "installing system packages: $*"
        { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"; } \
            >/dev/null 2>&1 || die "could not install them; run: apt-get update && apt-get install -y $*"
    elif command -v sudo >/dev/null 2>&1 && sudo -n true 2>/dev/null; then
        say "installing system packages: $*"
        { sudo -n apt-get update -qq && sudo -n env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@"; } \
            >/dev/null 2>&1 || die "could not install them; run: sudo apt-get update && sudo apt-get install -y $*"
    else
        die "missing system packages; run: sudo apt-get update && sudo apt-get install -y $*"
    fi
}

# The first Python of at least 3.11, by name; nothing when there is none.
find_python() {
    local name
    for name in python3 python3.13 python3.12 python3.11 python; do
        if command -v "$name" >/dev/null 2>&1 &&
            "$name" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2])' >/dev/null 2>&1; then
            command -v "$name"
            return
        fi
    done
}

# What Open3D and VTK load from the system (on Linux; elsewhere their wheels bring all).
check_libraries() {
    [ "$(uname -s)" = Linux ] || return 0
    local python="$1" missing=() pair
    for pair in libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libgomp.so.1:libgomp1 libX11.so.6:libx11-6 libEGL.so.1:libegl1; do
        "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "${pair%%:*}" >/dev/null 2>&1 || missing+=("${pair##*:}")
    done
    [ ${#missing[@]} = 0 ] || system_packages "${missing[@]}"
}

make_environment() {
    local python stamp want
    python="$(find_python)"
    if [ -z "$python" ]; then
        system_packages python3 python3-venv
        python="$(find_python)"
        [ -n "$python" ] || die "needs Python 3.11 or newer; this system's python3 is older"
    fi
    check_libraries "$python"
    stamp=".venv/.installed"
    want="$("$python" -c 'import hashlib, pathlib, sys; print(hashlib.sha256(pathlib.Path("pyproject.toml").read_bytes() + sys.version.encode() + str(pathlib.Path.cwd()).encode()).hexdigest())')"
    if [ -x .venv/bin/python ] && [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$want" ]; then
        return
    fi
    if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        system_packages python3-venv
    fi
    if ! .venv/bin/python -c 'import sys, pip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
        say "making .venv with $("$python" --version)"
        "$python" -m venv --clear .venv || die "could not make .venv; is the disk full, or the folder read-only?"
    fi
    say "installing bimfit and what it needs into .venv (about 2 GB, a few minutes the first time)"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]' ||
        die "pip could not install the packages; the lines above say why (a network or a proxy, most often)"
    printf '%s\n' "$want" >"$stamp"
}

make_environment
