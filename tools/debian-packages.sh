#!/bin/sh
# Install the Debian packages that `make install` (argument: run), `make test` (run test), `make deb`
# (deb), `make arm` (arm) or `make dashboard-check` (look) needs and that are missing. Says what it
# does; asks for root only if something is missing.
set -eu

packages=""
need() { # need PACKAGE REASON: if it is not installed
    status=$(dpkg-query -W -f '${db:Status-Status}' "$1" 2>/dev/null || true)
    if [ "$status" != installed ]; then
        packages="$packages $1"
        echo "missing package: $1 ($2)"
    fi
}

if ! command -v dpkg-query >/dev/null; then
    echo "Not a Debian system: $0 installs nothing. Needed: Python >= 3.11 with venv; for the tests" \
        "also mosquitto, iproute2 and a kernel with vcan (docs/vcan.md)."
    exit 0
fi

for purpose in "$@"; do
    case $purpose in
    run)
        # Another Python than Debian's brings its own venv.
        "${PYTHON:-python3}" -c 'import ensurepip' 2>/dev/null || need python3-venv "virtual environment"
        ;;
    test)
        need mosquitto "MQTT broker of the tests"
        need gpsd "reads what we serve as gpsd and as NMEA"
        need iproute2 "sets up vcan0"
        need kmod "loads the CAN modules of the test kernel"
        need can-utils "candump, to look at a bus by hand"
        need systemd "verifies the unit, and installs and runs it in the test kernel"
        need udev "udevadm, which the installation calls"
        need groff-base "reads the manual pages"
        need openssl "certificates for the tests of the broker"
        if [ "$(dpkg --print-architecture)" = amd64 ]; then
            need user-mode-linux "a kernel with vcan, for hosts that have none"
            if grep -q amx_tile /proc/cpuinfo && ! command -v cc >/dev/null; then
                need gcc "User Mode Linux on this processor needs tests/hil/xstate.c"
                need libc6-dev "headers for it"
            fi
        fi
        ;;
    deb)
        need binutils "strip, for a package without what only a debugger reads"
        ;;
    arm)
        need qemu-user-static "runs programs of aarch64 (make arm)"
        ;;
    look)
        need chromium "browser that looks at the dashboard"
        ;;
    *)
        echo "usage: $0 run|test|deb|arm|look ..." >&2
        exit 64
        ;;
    esac
done
[ -n "$packages" ] || exit 0

root=""
if [ "$(id -u)" != 0 ]; then
    if ! command -v sudo >/dev/null; then
        echo "Not root and no sudo: run as root: apt-get install --no-install-recommends$packages" >&2
        exit 1
    fi
    root=sudo
fi
export DEBIAN_FRONTEND=noninteractive
echo "installing with apt-get:$packages"
# shellcheck disable=SC2086  # a list of words
install() { $root apt-get install -y -q --no-install-recommends $packages; }
# A fresh machine or a container has no package lists, or old ones: fetch them once and try again.
if ! ls /var/lib/apt/lists/*Packages* >/dev/null 2>&1 || ! install; then
    $root apt-get update -q
    install
fi
