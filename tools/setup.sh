#!/usr/bin/env bash
# Makes .venv ready: python, the system's shared libraries, gsvis itself. Called by the Makefile as
#   tools/setup.sh [GROUPS]     GROUPS: groups of pyproject.toml, such as report or all,dev; all when left out
# As root it installs what the system lacks through apt-get; otherwise it prints the one line to run and stops.
set -euo pipefail
cd "$(dirname "$0")/.."

python=${PYTHON:-python3}
venv=.venv
groups=${1:-all}

say() { printf 'setup: %s\n' "$*" >&2; }
stop() { say "$*"; exit 1; }

command -v "$python" >/dev/null || stop "no $python found; install Python 3.10 or newer, or call make PYTHON=/path/to/python3"
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
    stop "expected Python 3.10 or newer, got $("$python" -V 2>&1); call make PYTHON=/path/to/a/newer/python3"

# What a bare Debian lacks: venv is split from python3, and open3d's wheel links these libraries of the system.
missing=()
$venv/bin/python -m pip --version >/dev/null 2>&1 || "$python" -c 'import ensurepip, venv' 2>/dev/null ||
    missing+=("$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')")
if [ "$(uname -s)-$(uname -m)" = Linux-x86_64 ] && [[ ",$groups," = *,all,* ]]; then
    while read -r library package; do
        "$python" -c "import ctypes; ctypes.CDLL('$library')" 2>/dev/null || missing+=("$package")
    done <<'LIBRARIES'
libusb-1.0.so.0 libusb-1.0-0
libGL.so.1 libgl1
libEGL.so.1 libegl1
libX11.so.6 libx11-6
libudev.so.1 libudev1
libstdc++.so.6 libstdc++6
LIBRARIES
fi
if [ ${#missing[@]} -gt 0 ]; then
    if ! command -v apt-get >/dev/null; then
        stop "the system lacks what Debian calls ${missing[*]}; install it with your package manager and run make again"
    elif [ "$(id -u)" -ne 0 ]; then
        stop "the system lacks ${missing[*]}; run this once, then make again:  sudo apt-get install -y ${missing[*]}"
    fi
    say "installing ${missing[*]} with apt-get"
    log=$(mktemp)
    { apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get -o DPkg::Lock::Timeout=120 install -y -qq --no-install-recommends "${missing[@]}"; } \
        >"$log" 2>&1 || { cat "$log" >&2; stop "apt-get could not install ${missing[*]}"; }
    rm -f "$log"
fi

if ! $venv/bin/python -m pip --version >/dev/null 2>&1; then  # none yet, or one that was interrupted
    say "creating $venv with $("$python" -V)"
    "$python" -m venv $venv
fi

# Python compiles a module when it is first imported: pip would compile all of them, most of which nobody imports.
say "installing gsvis[$groups] into $venv (minutes the first time)"
$venv/bin/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt --editable ".[$groups]"
tracers=embreex
[[ ",$groups," != *,all,* ]] || tracers+=", open3d"
$venv/bin/python -c "import $tracers" || stop "the ray tracers do not load; the line above names what is missing"
say "ready"
