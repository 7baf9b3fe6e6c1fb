#!/bin/sh
# Installs the shared libraries that the wheels load but do not contain, or prints the command for it.
missing=""
need() {  # need SONAME DEBIAN-PACKAGE
    /sbin/ldconfig -p 2>/dev/null | grep -q "$1" || missing="$missing $2"
}
need libusb-1.0.so.0 libusb-1.0-0
need libgomp.so.1 libgomp1
need libEGL.so.1 libegl1
need libGL.so.1 libgl1
need libX11.so.6 libx11-6
[ -z "$missing" ] && exit 0

if ! command -v apt-get >/dev/null 2>&1; then
    echo "Missing system libraries (Debian names):$missing. Install your distribution's packages of them, then run make again." >&2
    exit 1
fi
if [ "$(id -u)" = 0 ]; then as_root=""; else as_root="sudo -n"; fi
echo "Installing system libraries:$missing" >&2
if $as_root apt-get update -qq && $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing >/dev/null; then
    exit 0
fi
echo "These libraries could not be installed here. Run this, then run make again:" >&2
echo "    sudo apt-get install$missing" >&2
exit 1
