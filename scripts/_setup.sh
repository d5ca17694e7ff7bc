# Sourced by scripts/demo and scripts/test: leaves a ready .venv, or stops with one line that says what to do.
# shellcheck shell=bash
set -euo pipefail
ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)"
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

# What Open3D and VTK load from the system (on Linux; elsewhere their wheels bring all), as library:package.
LIBRARIES=(libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libgomp.so.1:libgomp1 libX11.so.6:libx11-6 libEGL.so.1:libegl1)

# The packages that the given Python lacks to make .venv and to load the libraries; one a line.
missing_packages() {
    local python="$1" pair
    sound_environment || "$python" -c 'import ensurepip, venv' >/dev/null 2>&1 ||
        "$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'
    [ "$(uname -s)" = Linux ] || return 0
    for pair in "${LIBRARIES[@]}"; do
        "$python" -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' "${pair%%:*}" >/dev/null 2>&1 || echo "${pair##*:}"
    done
}

# Whether .venv can be kept: no install was cut off in it, it runs, and it was made in this very folder.
sound_environment() {
    [ ! -e .venv/.installing ] && [ -f .venv/bin/pip ] && grep -qF "$ROOT/.venv/bin/" .venv/bin/pip &&
        .venv/bin/python -c 'import sys, pip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1
}

make_environment() {
    local python missing want
    python="$(find_python)"
    if [ -z "$python" ]; then
        ! command -v python3 >/dev/null 2>&1 ||
            die "needs Python 3.11 or newer, and this is $(python3 --version 2>&1); install python3.11 and python3.11-venv, or newer"
        system_packages python3 python3-venv "${LIBRARIES[@]##*:}"
        python="$(find_python)"
        [ -n "$python" ] || die "needs Python 3.11 or newer; this system's python3 is older"
    fi
    missing="$(missing_packages "$python")"
    # shellcheck disable=SC2086  # one word a package
    [ -z "$missing" ] || system_packages $missing
    want="$("$python" -c 'import hashlib, pathlib, sys; print(hashlib.sha256(pathlib.Path("pyproject.toml").read_bytes() + sys.version.encode() + str(pathlib.Path.cwd()).encode()).hexdigest())')"
    if [ -x .venv/bin/python ] && [ -f .venv/.installed ] && [ "$(cat .venv/.installed)" = "$want" ]; then
        return
    fi
    if ! sound_environment; then
        say "making .venv with $("$python" --version)"
        "$python" -m venv --clear .venv || die "could not make .venv; is the disk full, or the folder read-only?"
    fi
    say "installing bimfit and what it needs into .venv (about 3 GB, a few minutes the first time)"
    rm -f .venv/.installed
    : >.venv/.installing
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]' ||
        die "pip could not install the packages; the lines above say why (a network or a proxy, most often)"
    rm .venv/.installing
    printf '%s\n' "$want" >.venv/.installed
}

# One at a time: a second run waits until the first has installed.
(
    if command -v flock >/dev/null 2>&1; then flock 9; fi
    make_environment
) 9<pyproject.toml
